"""Results that take a minute and do not change, kept in the user's cache folder as JSON.

The folder is `$ISOCHARGE_CACHE`, else `$XDG_CACHE_HOME/isocharge`, else `~/.cache/isocharge`. A file is named by the
hash of all that its result depends on; one that is damaged counts as absent.
"""

import json
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from isocharge.files import sha256_of, write_whole


def cache_folder() -> Path:
    """Where results are kept; it need not exist yet."""
    if own := os.environ.get("ISOCHARGE_CACHE"):
        return Path(own)
    shared = os.environ.get("XDG_CACHE_HOME")
    return (Path(shared) if shared else Path.home() / ".cache") / "isocharge"


def cached(name: str, key: dict[str, Any], compute: Callable[[], Any]) -> Any:
    """The result of `compute`, from the cache if it is there, otherwise computed and kept.

    Args:
        name: What the result is, for the file's name.
        key: All that it depends on, as JSON can say it.
        compute: Gives the result, as JSON can say it.
    """
    question = _text(key)
    path = cache_folder() / f"{name}-{sha256_of(question)[:24]}.json"
    found = _read(path, key)
    if found is not None:
        return found
    result = json.loads(_text(compute()))  # as a later call will read it
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, _text({"key": key, "sha256": sha256_of(_text(result)), "result": result}))
    except OSError as error:
        warnings.warn(f"{path}: the result cannot be kept and will be computed again: {error}", stacklevel=2)
    return result


def _text(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def _read(path: Path, key: dict[str, Any]) -> Any:
    """What a file holds, or None if it is absent, damaged or about something else."""
    try:
        found = json.loads(path.read_bytes())
        whole = sha256_of(_text(found["result"])) == found["sha256"]
        return found["result"] if whole and _text(found["key"]) == _text(key) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
