"""Cache for results that take long to compute.

The results are stored in build/kept. The workers of a test run share them, and later runs use them again.
"""

import hashlib
import inspect
import pickle
import shutil
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path

import numpy as np
from filelock import FileLock

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "build" / "kept"
MAX_VERSIONS = 4
"""Largest number of versions of the code whose results are kept."""

SOURCES = {
    "simulate": ("serve/isocharge/common", "simulate/isocharge/simulate"),
    "train": ("serve/isocharge/common", "simulate/isocharge/simulate", "train/isocharge/train"),
}


def kept(make, *arguments, **options):
    """Return `make(*arguments, **options)`, computed now or stored by an earlier call.

    A stored result is used if the arguments, the source of `make`, the source of the packages and the version of NumPy
    are the same.

    Args:
        make: Function of simulate, train or their tests. Its result can be pickled.
        arguments: Its positional arguments.
        options: Its keyword arguments.
    """
    where = Path(inspect.getsourcefile(make)).relative_to(ROOT).parts
    folder = FOLDER / _code("simulate" if "simulate" in where else "train")
    key = pickle.dumps(
        (np.__version__, inspect.getsource(make), *map(_fields, (arguments, tuple(sorted(options.items())))))
    )
    path = folder / f"{make.__name__}-{hashlib.sha256(key).hexdigest()[:16]}.pickle"
    FOLDER.mkdir(parents=True, exist_ok=True)
    with FileLock(FOLDER / f"{path.name}.lock"):
        if not path.exists():
            _make_room(folder)
            result = make(*arguments, **options)
            part = path.with_suffix(".part")
            part.write_bytes(pickle.dumps(result))
            part.rename(path)
        return pickle.loads(path.read_bytes())


def _fields(value):
    """Return a value in which dataclasses are replaced by their fields.

    A dataclass may also contain cached properties. They do not belong to the key, because they depend on earlier use.
    """
    if is_dataclass(value) and not isinstance(value, type):
        return type(value).__name__, [_fields(getattr(value, field.name)) for field in fields(value)]
    return [*map(_fields, value)] if isinstance(value, tuple) else value


@cache
def _code(packages):
    """Return a name that identifies the present source of some packages."""
    digest = hashlib.sha256()
    for source in SOURCES[packages]:
        for path in sorted((ROOT / source).rglob("*.py")):
            digest.update(path.read_bytes())
    return f"{packages}-{digest.hexdigest()[:16]}"


def _make_room(folder):
    """Create the folder of the present code, and delete the folders of the oldest versions."""
    folder.mkdir(exist_ok=True)
    versions = sorted((path for path in FOLDER.iterdir() if path.is_dir()), key=lambda path: path.stat().st_mtime)
    for old_folder in versions[: -2 * MAX_VERSIONS]:  # each version has a folder for simulate and one for train
        if old_folder != folder:
            shutil.rmtree(old_folder, ignore_errors=True)
