"""Fingerprint of the code that results depend on."""

import hashlib
import importlib.metadata
from functools import lru_cache
from pathlib import Path


@lru_cache(maxsize=1)
def code_fingerprint() -> str:
    """The code that results depend on: package, checksum of its source, libraries."""
    source = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        source.update(path.read_bytes())
    versions = [f"{name} {importlib.metadata.version(name)}" for name in ("isocharge", "numpy", "scipy")]
    return f"{versions[0]} ({source.hexdigest()[:12]}), {versions[1]}, {versions[2]}"
