"""Files and folders that exist whole or not at all."""

import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from isocharge.errors import IsochargeError, OutputError, OutputExists


def sha256_of(data: bytes) -> str:
    """Hexadecimal SHA-256."""
    return hashlib.sha256(data).hexdigest()


def refuse_existing(path: Path) -> None:
    """Raise OutputExists if there is something at `path` already."""
    if path.exists():
        raise OutputExists(f"{path} is already there and is not overwritten; choose another output or remove it")


def write_whole(path: Path, data: bytes) -> None:
    """Write a file under a temporary name, bring it to disk, and only then give it its name."""
    draft = _draft_of(path)
    try:
        with draft.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Fill a folder out of sight and give it its name when the block ends well; on an error nothing remains.

    Args:
        path: The folder to create, with its parents.

    Yields:
        A temporary sibling to write into.

    Raises:
        OutputExists: If `path` is already there, or another process creates it meanwhile.
        OutputError: If the file system refuses.
    """
    refuse_existing(path)
    missing = [parent for parent in path.parents if not parent.exists()]
    draft = _draft_of(path)
    try:
        draft.mkdir(parents=True)
        yield draft
        sync_folder(draft)
        _rename(draft, path)
        sync_folder(path.parent)
    except BaseException as error:
        shutil.rmtree(draft, ignore_errors=True)
        for parent in missing:
            _remove_empty(parent)
        if isinstance(error, OSError) and not isinstance(error, IsochargeError):
            raise OutputError(f"{path} cannot be written: {error.strerror or error}; choose another output") from error
        raise


def _draft_of(path: Path) -> Path:
    return path.with_name(f".{secrets.token_hex(4)}.draft")


def _rename(draft: Path, path: Path) -> None:
    try:
        draft.rename(path)
    except OSError:
        refuse_existing(path)  # another process was faster
        raise


def _remove_empty(folder: Path) -> None:
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def sync_folder(folder: Path) -> None:
    """Make sure that renames in a folder survive a power cut."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
