"""Fingerprint of the code on which the results of a simulation depend."""

import hashlib
import importlib.metadata
from functools import lru_cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]
"""Folder of the package isocharge.simulate."""

LIBRARIES = ("numpy", "scipy", "shapely")
"""Libraries whose versions affect the results of a simulation."""


@lru_cache(maxsize=1)
def code_fingerprint() -> str:
    """Return a text that identifies the code of the simulator and the versions of the numerical libraries.

    The text contains the versions of isocharge, NumPy, SciPy and shapely, and a checksum of the source files of
    isocharge.simulate and of the files of the built-in sensors.
    """
    checksum = hashlib.sha256()
    for path in sources():
        relative_path = path.relative_to(PACKAGE).as_posix()
        checksum.update(relative_path.encode() + b"\0" + path.read_bytes())  # a zero byte ends the path
    short_checksum = checksum.hexdigest()[:12]
    isocharge_version = importlib.metadata.version("isocharge")
    libraries = [f"{name} {importlib.metadata.version(name)}" for name in LIBRARIES]
    return ", ".join([f"isocharge {isocharge_version} ({short_checksum})", *libraries])


def sources() -> list[Path]:
    """Return the files that the checksum covers. Their order is the same on every machine."""
    return sorted([*PACKAGE.rglob("*.py"), *PACKAGE.rglob("*.toml")], key=lambda path: path.as_posix())
