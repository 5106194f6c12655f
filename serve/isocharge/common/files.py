"""Reading and writing of files. A written file or folder exists either completely or not at all."""

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

MAX_FILE_BYTES = 64 << 20
"""Largest size of a file that is read by `read_whole`, bytes."""

MAX_LINE_CHARACTERS = 1 << 20
"""Largest number of characters of a line in a text that is read line by line."""

READ_FLAGS = os.O_RDONLY | sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_CLOEXEC", "O_BINARY"))
"""Flags for opening a file without waiting for the writer of a pipe. Flags that a system does not have are left out."""

WRITE_FLAGS = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0)
"""Flags for creating a file that must not exist."""


def sha256_of(data: bytes) -> str:
    """Return the SHA-256 checksum in hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading, without waiting for the writer of a pipe.

    Raises:
        OSError: If the file cannot be opened, or is a pipe, a device or a folder. Its `strerror` states the reason.
    """
    descriptor = os.open(path, READ_FLAGS)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    return os.fdopen(descriptor, "rb")


def read_whole(path: Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Read the bytes of a regular file.

    Args:
        path: The file. A pipe or a device is refused, because reading it might never end.
        max_bytes: Largest size, bytes.

    Raises:
        OSError: If the file cannot be read, is not a regular file, or is larger than `max_bytes`. Its `strerror` states
            the reason.
    """
    too_large = OSError(errno.EFBIG, f"larger than {max_bytes} bytes", str(path))
    with open_regular(path) as file:
        if os.fstat(file.fileno()).st_size > max_bytes:
            raise too_large
        data = file.read(max_bytes + 1)  # the file may have grown in the meantime
    if len(data) > max_bytes:
        raise too_large
    return data


def bounded_lines(file: TextIO, max_characters: int = MAX_LINE_CHARACTERS) -> Iterator[str]:
    """Yield the lines of a text, each with its line end.

    Args:
        file: The text.
        max_characters: Largest number of characters of a line.

    Raises:
        ValueError: If a line is longer than `max_characters`, or cannot be decoded.
    """
    while line := file.readline(max_characters + 1):
        if len(line) > max_characters:
            raise ValueError(f"a line is longer than {max_characters} characters")
        yield line


def read_needed(path: Path, error: type[IsochargeError], advice: str, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Read the bytes of a regular file. If the file cannot be read, raise an error that states what to do.

    Args:
        path: The file.
        error: Class of the error.
        advice: What the user can do, for the error message.
        max_bytes: Largest size, bytes.
    """
    try:
        return read_whole(path, max_bytes)
    except OSError as cause:
        raise error(f"{path}: cannot be read ({cause.strerror}); {advice}") from cause


def refuse_existing(path: Path) -> None:
    """Raise OutputExists if a file or a folder exists at the path."""
    if path.exists():
        raise OutputExists(f"{path} is already there and is not overwritten; choose another output or remove it")


def write_whole(path: Path, data: bytes) -> None:
    """Write a file under a temporary name, flush it to disk, and then rename it.

    A reader therefore sees either the complete old file or the complete new file.

    Args:
        path: The file. An existing file is replaced.
        data: Content of the file.
    """
    temporary = _temporary_path(path)
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)  # the file only exists under this name if an error occurred


class AtomicWriter:
    """Writer of a new file that appends data completely or not at all.

    The writer has the methods of a binary file that MCAP and text writers use.
    """

    def __init__(self, path: Path) -> None:
        """Create the file.

        Raises:
            OutputExists: If the file exists already.
            OutputError: If the file cannot be created.
        """
        refuse_existing(path)
        with as_output_errors(path):
            self._descriptor = os.open(path, WRITE_FLAGS, 0o666)
        self._size = 0  # number of bytes that complete calls of `write` have written

    def write(self, data: bytes) -> int:
        """Append data to the file. If an OSError is raised, the file is unchanged.

        Data of an earlier call that was interrupted, for example by Ctrl-C, are overwritten.
        """
        unwritten = memoryview(data)
        try:
            os.lseek(self._descriptor, self._size, os.SEEK_SET)
            while unwritten:  # one call may write only a part of the data
                written_bytes = os.write(self._descriptor, unwritten)
                unwritten = unwritten[written_bytes:]
        except OSError:
            os.ftruncate(self._descriptor, self._size)
            raise
        self._size += len(data)
        return len(data)

    def tell(self) -> int:
        """Return the number of bytes that were written."""
        return self._size

    def flush(self) -> None:
        """Do nothing, because no data are buffered."""

    def close(self) -> None:
        """Remove the data of an interrupted call, and close the file."""
        os.ftruncate(self._descriptor, self._size)
        os.close(self._descriptor)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Create a file under a temporary name, and rename it at the end of the block. After an error nothing remains.

    Args:
        path: The final path of the file.

    Yields:
        Temporary path in the same folder, where the block creates a file or a folder.

    Raises:
        OutputExists: If `path` exists already, or another process creates it in the meantime.
        OutputError: If the file cannot be written.
    """
    refuse_existing(path)
    temporary = _temporary_path(path)
    try:
        with as_output_errors(path):
            yield temporary
            flush_to_disk(temporary)
            refuse_existing(path)  # another process may have created it in the meantime
            temporary.rename(path)
            flush_to_disk(path.parent)
    finally:
        # Neither a folder nor a file has this name any more, unless an error occurred.
        shutil.rmtree(temporary, ignore_errors=True)  # if it is a folder
        with suppress(OSError):
            temporary.unlink()  # if it is a file


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Create a folder under a temporary name, and rename it at the end of the block. After an error nothing remains.

    Args:
        path: The folder. Missing parent folders are created, too.

    Yields:
        The temporary folder, in which the block writes.

    Raises:
        OutputExists: If `path` exists already, or another process creates it in the meantime.
        OutputError: If the folder cannot be written.
    """
    missing_parents = [parent for parent in path.parents if not parent.exists()]
    try:
        with new_file(path) as temporary:
            temporary.mkdir(parents=True)
            yield temporary
    finally:
        remove_empty(missing_parents)  # after an error they are empty; otherwise they contain the new folder


def _temporary_path(path: Path) -> Path:
    return path.with_name(f".{secrets.token_hex(4)}.draft")


@contextmanager
def as_output_errors(path: Path, advice: str = "choose another output") -> Iterator[None]:
    """Convert an OSError that the block raises to an OutputError.

    Args:
        path: The output, for the error message.
        advice: What the user can do, for the error message.
    """
    try:
        yield
    except OSError as error:
        # Errors of isocharge have their own message already, and a broken pipe is not an error of this output.
        if isinstance(error, IsochargeError | BrokenPipeError):
            raise
        raise OutputError(f"{path} cannot be written: {error.strerror or error}; {advice}") from error


def remove_empty(folders: Iterable[Path]) -> None:
    """Remove those of the given folders that are empty. All other folders remain unchanged.

    Inner folders must come before outer folders.
    """
    for folder in folders:
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def flush_to_disk(path: Path) -> None:
    """Flush a folder or a file to disk, so that renames or contents survive a power failure.

    The function does nothing on Windows, where a folder cannot be opened.
    """
    is_windows = not hasattr(os, "O_DIRECTORY")
    if is_windows:
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
