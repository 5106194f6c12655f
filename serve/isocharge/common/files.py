"""Reading and writing of files and folders.

A new file or folder appears under its final name only when it is complete.
"""

import errno
import hashlib
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from isocharge.common.errors import IsochargeError, OutputError, OutputExists

StrPath = str | Path
"""Path of a file or a folder, as a text or as a `Path`."""

MAX_FILE_BYTES = 64 << 20
"""Largest size of a file that is read by `read_whole`, and of the unpacked arrays of an npz file, bytes."""

MAX_LINE_CHARACTERS = 1 << 20
"""Largest number of characters of a line in a text that is read line by line."""


def sha256_of(data: bytes) -> str:
    """Return the SHA-256 checksum of data in hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def read_whole(path: Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Read all bytes of a regular file.

    Args:
        path: The file. A pipe or a device is refused, because reading it might never end.
        max_bytes: Largest size of the file, bytes.

    Raises:
        OSError: If the file cannot be read, is not a regular file, or is larger than `max_bytes`. The attribute
            `strerror` of the exception states the reason.
    """
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    with path.open("rb") as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise OSError(errno.EFBIG, f"larger than {max_bytes} bytes", str(path))
    return data


def bounded_lines(file: TextIO, max_characters: int = MAX_LINE_CHARACTERS) -> Iterator[str]:
    """Yield the lines of a text file including their line ends, and refuse lines that are too long.

    Args:
        file: The text file, which is open for reading.
        max_characters: Largest number of characters of a line, including its line end.

    Raises:
        ValueError: If a line is longer than `max_characters`, or cannot be decoded.
    """
    while line := file.readline(max_characters + 1):
        if len(line) > max_characters:
            raise ValueError(f"a line is longer than {max_characters} characters")
        yield line


def read_needed(path: Path, error_class: type[IsochargeError], advice: str, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Read all bytes of a regular file. If the file cannot be read, raise an error of a given class with advice.

    Args:
        path: The file.
        error_class: Class of the error.
        advice: Text for the error message that states what the user can do.
        max_bytes: Largest size of the file, bytes.

    Raises:
        error_class: If the file cannot be read, is not a regular file, or is larger than `max_bytes`.
    """
    try:
        return read_whole(path, max_bytes)
    except OSError as cause:
        raise error_class(f"{path}: cannot be read ({cause.strerror}); {advice}") from cause


def check_new_output(path: Path) -> None:
    """Check that an output can be created: nothing exists at its path, and the folder of the path is writable.

    Raises:
        OutputExists: If the path exists, even if it is only a link to a path that does not exist.
        OutputError: If the nearest existing folder above the path is not writable.
    """
    if os.path.lexists(path):
        raise OutputExists(f"{path} is already there and is not overwritten; choose another output or remove it")
    existing = next(parent for parent in path.absolute().parents if os.access(parent, os.F_OK))
    if not (existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)):
        raise OutputError(f"{path} cannot be written: {existing} is not a writable folder; choose another output")


def write_whole(path: Path, data: bytes) -> None:
    """Write a file under a temporary name, flush the file to disk, and rename the file.

    A program that reads the file therefore reads either the complete old content or the complete new content.

    Args:
        path: The file. An existing file is replaced.
        data: New content of the file.

    Raises:
        OSError: If the file cannot be written. The old file then remains unchanged.
    """
    temporary_path = _temporary_path(path)
    try:
        temporary_path.write_bytes(data)
        flush_to_disk(temporary_path)
        temporary_path.replace(path)
    finally:
        temporary_path.unlink(missing_ok=True)  # a file with the temporary name only exists if an error occurred


class AtomicWriter:
    """Writer of a new file. Each call of `write` appends its data either completely or not at all.

    The class has the methods of a binary file that MCAP writers and text writers use.
    """

    def __init__(self, path: Path) -> None:
        """Create the file.

        Args:
            path: The file. It must not exist.

        Raises:
            OutputExists: If the file exists already.
            OSError: If the file cannot be created.
        """
        check_new_output(path)
        self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        self._size = 0  # number of bytes that complete calls of `write` have written

    def write(self, data: bytes) -> int:
        """Append data to the file.

        If an earlier call was interrupted, for example by Ctrl-C, this call overwrites the incomplete data of the
        earlier call.

        Args:
            data: The data to append.

        Returns:
            Number of bytes of the data.

        Raises:
            OSError: If the data cannot be written. The file is then unchanged.
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
        """Return the number of bytes that complete calls of `write` have written."""
        return self._size

    def flush(self) -> None:
        """Do nothing, because no data are buffered."""

    def close(self) -> None:
        """Remove the incomplete data of an interrupted call of `write`, and close the file."""
        os.ftruncate(self._descriptor, self._size)
        os.close(self._descriptor)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Provide a temporary path at which the `with` block creates a new file or folder.

    At the end of the block, the file or folder is renamed to its final path. If the block raises an exception, the file
    or folder is removed.

    Args:
        path: The final path of the file or folder.

    Yields:
        Temporary path in the same parent folder, at which the block creates the file or folder.

    Raises:
        OutputExists: If `path` exists already, or another process creates it in the meantime.
        OutputError: If the file or folder cannot be written.
    """
    check_new_output(path)
    temporary_path = _temporary_path(path)
    try:
        with as_output_errors(path):
            yield temporary_path
            flush_to_disk(temporary_path)
            check_new_output(path)  # another process may have created the path in the meantime
            temporary_path.rename(path)
            flush_to_disk(path.parent)
    finally:
        # After an error, the temporary path is still a folder or a file, and is removed. Without an error, it does not
        # exist any more, and the two calls do nothing.
        shutil.rmtree(temporary_path, ignore_errors=True)  # removes only a folder
        with suppress(OSError):
            temporary_path.unlink()  # removes only a file


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """Create a folder under a temporary name, and rename the folder to its final name at the end of the `with` block.

    If the block raises an exception, the folder is removed.

    Args:
        path: The final path of the folder. Missing parent folders are created, too.

    Yields:
        Path of the temporary folder, into which the block writes files.

    Raises:
        OutputExists: If `path` exists already, or another process creates it in the meantime.
        OutputError: If the folder cannot be written.
    """
    missing_parents = [parent for parent in path.parents if not os.path.lexists(parent)]  # the deepest one first
    try:
        # `new_file` chooses the temporary path. At the end, it renames or removes the folder that is created there.
        with new_file(path) as temporary_path:
            temporary_path.mkdir(parents=True)
            yield temporary_path
    finally:
        # After an error, remove the parents that were created. Otherwise, they contain the new folder, and `rmdir`
        # fails because they are not empty.
        for parent in missing_parents:
            with suppress(OSError):
                parent.rmdir()


def _temporary_path(path: Path) -> Path:
    """Return a hidden path with a random name in the same folder as `path`."""
    return path.with_name(f".{secrets.token_hex(4)}.draft")


@contextmanager
def as_output_errors(path: StrPath) -> Iterator[None]:
    """If the `with` block raises an OSError, raise an OutputError instead.

    Args:
        path: Path or target of the output, for the error message.

    Raises:
        OutputError: If the block raises an OSError that is neither an error of isocharge nor a broken pipe.
    """
    try:
        yield
    except OSError as error:
        # An error of isocharge already has a message for the user. A broken pipe is not an error of this output.
        if isinstance(error, IsochargeError | BrokenPipeError):
            raise
        raise OutputError(f"{path} cannot be written: {error.strerror or error}; choose another output") from error


def flush_to_disk(path: Path) -> None:
    """Flush a file or a folder to disk, so that its content survives a power failure.

    If the path is a folder, the names of its files are flushed.

    Args:
        path: The file or the folder.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
