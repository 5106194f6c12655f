"""Files and folders that exist whole or not at all."""

import errno
import hashlib
import os
import secrets
import shutil
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, TextIO

from isocharge.common.errors import IsochargeError, OutputError, OutputExists

MOST_BYTES = 64 << 20
"""Largest file that is read whole, bytes: far more than any file of ours has."""

LONGEST_LINE = 1 << 20
"""Longest line of a text that is read line by line, characters."""


READ_FLAGS = os.O_RDONLY | sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_CLOEXEC", "O_BINARY"))
"""To open a file without waiting for a pipe's writer, and without changing line ends; each system has its part."""

WRITE_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
"""To open a new file, without changing line ends."""


def sha256_of(data: bytes) -> str:
    """Hexadecimal SHA-256."""
    return hashlib.sha256(data).hexdigest()


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading, without waiting for the writer of a pipe.

    Raises:
        OSError: If the file cannot be opened or is a pipe, a device or a folder; `strerror` says which.
    """
    descriptor = os.open(path, READ_FLAGS)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return os.fdopen(descriptor, "rb")


def read_whole(path: Path, most: int = MOST_BYTES) -> bytes:
    """Read the bytes of a regular file.

    Args:
        path: The file. A pipe or a device is refused, because to read one may never end.
        most: Largest size, bytes.

    Raises:
        OSError: If the file cannot be read, is not a regular file, or is larger; `strerror` says which.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        data = file.read(most + 1) if size <= most else b""
        if max(len(data), size) > most:
            raise OSError(errno.EFBIG, f"larger than {most} bytes", str(path))
        return data


def bounded_lines(file: TextIO, longest: int = LONGEST_LINE) -> Iterator[str]:
    """The lines of a text, each with its end, none longer than can be held.

    Raises:
        ValueError: If a line has more than `longest` characters, or is no text in the encoding of the file.
    """
    while line := file.readline(longest + 1):
        if len(line) > longest:
            raise ValueError(f"a line is longer than {longest} characters")
        yield line


def read_needed(path: Path, error: type[IsochargeError], advice: str, most: int = MOST_BYTES) -> bytes:
    """As `read_whole`, but raises `error`, with advice on what to do."""
    try:
        return read_whole(path, most)
    except OSError as cause:
        raise error(f"{path}: cannot be read ({cause.strerror}); {advice}") from cause


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


class WholeWrites:
    """A new file that takes data whole or not at all: as much of a file as its writers use."""

    def __init__(self, path: Path) -> None:
        """Create it.

        Raises:
            OutputExists: If it is already there.
            OutputError: If it cannot be created.
        """
        refuse_existing(path)
        with refusals_explained(path):
            self._descriptor = os.open(path, WRITE_FLAGS, 0o666)
        self._size = 0

    def write(self, data: bytes) -> int:
        """Write, over what an interruption left of a write; after an OSError the file is as it was before."""
        unwritten = memoryview(data)
        try:
            os.lseek(self._descriptor, self._size, os.SEEK_SET)
            while unwritten:
                unwritten = unwritten[os.write(self._descriptor, unwritten) :]
        except OSError:
            os.ftruncate(self._descriptor, self._size)
            raise
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Bytes that were written."""
        return self._size

    def flush(self) -> None:
        """Nothing waits here."""

    def close(self) -> None:
        """Close it, without what an interruption left of a write."""
        os.ftruncate(self._descriptor, self._size)
        os.close(self._descriptor)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Fill a file under a temporary name and give it its own when the block ends well; on an error nothing remains.

    Yields:
        The temporary name, a sibling; the block creates the file, or a folder.

    Raises:
        OutputExists: If `path` is already there, or another process creates it meanwhile.
        OutputError: If the file system refuses.
    """
    refuse_existing(path)
    draft = _draft_of(path)
    try:
        with refusals_explained(path):
            yield draft
            sync_folder(draft)
            refuse_existing(path)  # another process may have been faster
            draft.rename(path)
            sync_folder(path.parent)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        with suppress(OSError):
            draft.unlink()


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Fill a folder out of sight and give it its name when the block ends well; on an error nothing remains.

    Args:
        path: The folder to create, with its parents.

    Yields:
        A temporary sibling to write into.

    Raises:
        As `new_file`.
    """
    missing = [parent for parent in path.parents if not parent.exists()]
    try:
        with new_file(path) as draft:
            draft.mkdir(parents=True)
            yield draft
    finally:
        remove_empty(missing)


def _draft_of(path: Path) -> Path:
    return path.with_name(f".{secrets.token_hex(4)}.draft")


@contextmanager
def refusals_explained(path: Path, advice: str = "choose another output") -> Iterator[None]:
    """Turn the file system's errors into OutputError."""
    try:
        yield
    except OSError as error:
        if isinstance(error, IsochargeError | BrokenPipeError):  # a pipe is no matter of this file
            raise
        raise OutputError(f"{path} cannot be written: {error.strerror or error}; {advice}") from error


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove the folders that are empty, the innermost first."""
    for folder in folders:
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def sync_folder(folder: Path) -> None:
    """Make sure that renames in a folder, or the content of a file, survive a power cut.

    Windows opens no folders, and is left to itself.
    """
    if not hasattr(os, "O_DIRECTORY"):
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
