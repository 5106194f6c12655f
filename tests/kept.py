"""Results that take long to make: made once, kept in build/kept, shared by the workers of a run and by later runs."""

import hashlib
import inspect
import pickle
import shutil
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path

from filelock import FileLock

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "build" / "kept"
MOST_VERSIONS = 4
"""Versions of the code whose results are kept."""

SOURCES = {
    "simulate": ("serve/isocharge/common", "simulate/isocharge/simulate"),
    "train": ("serve/isocharge/common", "simulate/isocharge/simulate", "train/isocharge/train"),
}


def kept(make, *arguments, **options):
    """`make(*arguments, **options)`, or what it gave before, if neither they nor the code that it runs has changed.

    `make` is a function of simulate, train or their tests; what it gives can be pickled.
    """
    where = Path(inspect.getsourcefile(make)).relative_to(ROOT).parts
    folder = FOLDER / _code("simulate" if "simulate" in where else "train")
    wanted = pickle.dumps((inspect.getsource(make), *map(_fields, (arguments, tuple(sorted(options.items()))))))
    path = folder / f"{make.__name__}-{hashlib.sha256(wanted).hexdigest()[:16]}.pickle"
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
    """A value without what a dataclass has cached beside its fields, which would be another key."""
    if is_dataclass(value) and not isinstance(value, type):
        return type(value).__name__, [_fields(getattr(value, field.name)) for field in fields(value)]
    return [*map(_fields, value)] if isinstance(value, tuple) else value


@cache
def _code(packages):
    """A name for the present source of some packages."""
    digest = hashlib.sha256()
    for source in SOURCES[packages]:
        for path in sorted((ROOT / source).rglob("*.py")):
            digest.update(path.read_bytes())
    return f"{packages}-{digest.hexdigest()[:16]}"


def _make_room(folder):
    """The folder of this code; those of the oldest code go."""
    folder.mkdir(exist_ok=True)
    versions = sorted((path for path in FOLDER.iterdir() if path.is_dir()), key=lambda path: path.stat().st_mtime)
    for old in versions[: -2 * MOST_VERSIONS]:
        if old != folder:
            shutil.rmtree(old, ignore_errors=True)
