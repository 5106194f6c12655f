"""Results that take a minute and do not change, stored in the user's cache folder as JSON.

The folder is `$ISOCHARGE_CACHE`, else `$XDG_CACHE_HOME/isocharge`, else `~/.cache/isocharge`. A file is named by the
hash of all that its result depends on; one that is damaged counts as absent.
"""

import json
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from isocharge.common.files import sha256_of, write_whole


def cache_folder() -> Path:
    """The folder of stored results; it need not exist yet."""
    if folder := os.environ.get("ISOCHARGE_CACHE"):
        return Path(folder)
    shared = os.environ.get("XDG_CACHE_HOME")
    return (Path(shared) if shared else Path.home() / ".cache") / "isocharge"


def cached(name: str, key: dict[str, Any], compute: Callable[[], Any]) -> Any:
    """The result of `compute`, from the cache, or computed and stored.

    Args:
        name: What the result is, for the file's name.
        key: All that it depends on, as JSON can say it.
        compute: Gives the result, as JSON can say it.
    """
    question = _text(key)
    path = cache_folder() / f"{name}-{sha256_of(question)[:24]}.json"
    stored = _read(path, key)
    if stored is not None:
        return stored
    result = json.loads(_text(compute()))  # as a later call will read it
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, _text({"key": key, "sha256": sha256_of(_text(result)), "result": result}))
    except OSError as error:
        warnings.warn(f"{path}: the result cannot be stored and will be computed again: {error}", stacklevel=2)
    return result


def _text(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def _read(path: Path, key: dict[str, Any]) -> Any:
    """What a file holds, or None if it is absent, damaged or about something else."""
    try:
        stored = json.loads(path.read_bytes())
        whole = sha256_of(_text(stored["result"])) == stored["sha256"]
        return stored["result"] if whole and _text(stored["key"]) == _text(key) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
