"""Fingerprint of the code that results depend on."""

import hashlib
import importlib.metadata
from functools import lru_cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
"""The folder of isocharge.simulate."""


@lru_cache(maxsize=1)
def code_fingerprint() -> str:
    """Version of the package, checksum of the simulator's sources, versions of the libraries it computes with.

    The sources are every module of isocharge.simulate, with its packages, and the built-in sensors.
    """
    source = hashlib.sha256()
    for path in sources():
        source.update(path.relative_to(PACKAGE).as_posix().encode() + b"\0" + path.read_bytes())
    versions = [f"{name} {importlib.metadata.version(name)}" for name in ("isocharge", "numpy", "scipy")]
    return f"{versions[0]} ({source.hexdigest()[:12]}), {versions[1]}, {versions[2]}"


def sources() -> list[Path]:
    """The files whose change is another fingerprint, in one order on every machine."""
    return sorted([*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.toml")], key=lambda path: path.as_posix())
