"""Runs that can be stopped and resumed. The finished parts of a run are stored next to the folder that the run writes.

    presses.part/
        run.json           settings of the run; a run with other settings does not use the folder
        lock               locked by the running process; the operating system unlocks it if the process is killed
        parts/<name>       finished part, and <name>.sha256
        data/<name>        file of the final folder, whose checksum is in parts/

A part is used only if its checksum exists and matches. All other parts are computed again.
"""

import fcntl
import io
import json
import logging
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, Future
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, OutputExists, SolveError, TrainingError, cut
from isocharge.common.files import (
    as_output_errors,
    flush_to_disk,
    new_folder,
    read_whole,
    refuse_existing,
    remove_empty,
    sha256_of,
    write_whole,
)
from isocharge.common.structs import read_json

Content = TypeVar("Content")

_log = logging.getLogger(__name__)

MAX_PART_BYTES = 1 << 30
"""Largest size of a part, bytes."""


class ResumableRun:
    """Stored parts of a run; see `resume_folder`.

    Attributes:
        target: Folder that the run writes.
        folder: Draft folder, which contains the parts until the run is finished.
        data: Folder in the draft that becomes the target.
    """

    def __init__(self, target: Path) -> None:
        self.target = target
        self.folder = draft_of(target)
        self.data = self.folder / "data"
        self._parts = self.folder / "parts"

    def save(self, name: str, data: bytes, *, final: bool = False) -> None:
        """Store a finished part.

        Args:
            name: Name of the part.
            data: Content of the part.
            final: Whether the part is a file of the target.

        Raises:
            OutputError: If the part cannot be written. Parts that were saved before remain.
        """
        with output_errors(self.target):
            write_whole(self._path(name, final), data)
            write_whole(self._parts / f"{name}.sha256", sha256_of(data).encode())

    def load(self, name: str, decode: Callable[[bytes], Content], *, final: bool = False) -> Content | None:
        """Load a finished part.

        Args:
            name: Name of the part.
            decode: Function from the bytes of the part to its content. It may raise any error if the part is damaged.
            final: Whether the part is a file of the target.

        Returns:
            The content; None if the part is not finished. If the part is damaged, a warning is logged and the result
            is None.
        """
        # The file with the checksum is written after the part. A part without this file is not finished.
        try:
            checksum = read_whole(self._parts / f"{name}.sha256").decode()
        except (OSError, UnicodeDecodeError):
            return None
        path = self._path(name, final)
        try:
            data = read_whole(path, MAX_PART_BYTES)
            if sha256_of(data) != checksum:
                raise ValueError(f"expected sha256 {checksum[:12]}..., got {sha256_of(data)[:12]}...")
            return decode(data)
        except Exception as error:  # decoders of other packages may raise any exception
            _log.warning("%s is damaged: %s; computed again", path, cut(str(error) or type(error).__name__))
            return None

    def storing_executor(self, name: str, executor: Executor | None = None) -> Executor:
        """Return an executor that stores the results of its tasks as parts of the run, and loads finished parts.

        The results must be arrays of numbers. The tasks are numbered in the order of their submission. A resumed run
        must therefore submit the same tasks in the same order.

        Args:
            name: Beginning of the names of the parts.
            executor: Executor that runs the tasks; None runs the tasks in this process.
        """
        return _StoringExecutor(self, name, executor)

    def is_empty(self) -> bool:
        """Return whether no part is finished."""
        return not any(self._parts.glob("*.sha256"))

    def _path(self, name: str, final: bool) -> Path:
        """Return the path of the file that stores a part of the run; see `save` for the arguments."""
        return (self.data if final else self._parts) / name

    def prepare(self) -> None:
        """Create the folders, and remove files that a killed process had not finished writing."""
        with output_errors(self.target):
            for folder in (self._parts, self.data):
                folder.mkdir(exist_ok=True)
                for incomplete_file in folder.glob(".*.draft"):  # the temporary names of `write_whole`
                    incomplete_file.unlink()

    def publish(self) -> None:
        """Rename the folder `data` to the target, and remove the draft.

        The folders are flushed to disk, so that the data and the renaming survive a power failure.
        """
        with output_errors(self.target):
            flush_to_disk(self.data)
            refuse_existing(self.target)
            self.data.rename(self.target)
            with suppress(OSError):  # an error here does not matter, because the target is complete
                flush_to_disk(self.target.parent)
        self.remove()

    def remove(self) -> None:
        """Remove the draft with all its parts."""
        shutil.rmtree(self.folder, ignore_errors=True)


class _StoringExecutor(Executor):
    """Executor of `ResumableRun.storing_executor`."""

    def __init__(self, run: ResumableRun, name: str, executor: Executor | None) -> None:
        self._run = run
        self._name = name
        self._executor = executor
        self._submitted = 0

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit a task whose result is stored as a part of the run, and return its future.

        If an earlier run has stored the result, the result is loaded. Otherwise the other executor computes the task.
        If there is no other executor, the task is computed before this method returns. The result is then stored.
        """
        part_name = f"{self._name}-{self._submitted:04d}.npy"  # parts are numbered in the order of submission
        self._submitted += 1
        stored_future: Future[Any] = Future()  # is done when the result is stored
        loaded_result = self._run.load(part_name, _decode_array)
        if loaded_result is not None:
            stored_future.set_result(loaded_result)
        elif self._executor is None:
            result = function(*args, **kwargs)
            self._run.save(part_name, _encode_array(result))
            stored_future.set_result(result)
        else:
            task_future = self._executor.submit(function, *args, **kwargs)
            task_future.add_done_callback(lambda _: self._store(part_name, task_future, stored_future))
            # If the caller cancels the future that it holds, the computation is cancelled as well.
            stored_future.add_done_callback(lambda _: task_future.cancel())
        return stored_future

    def _store(self, part_name: str, task_future: Future[Any], stored_future: Future[Any]) -> None:
        """Store the result of a task, and set it as the result of the future that `submit` returned.

        Args:
            part_name: Name of the part in which the result is stored.
            task_future: Future of the task, which is done or cancelled.
            stored_future: Future that `submit` has returned. It gets the result, or the error of the task or of the
                storing.
        """
        if task_future.cancelled():
            stored_future.cancel()

        # The caller may also have cancelled the future. From this call on, it can no longer be cancelled.
        is_cancelled = not stored_future.set_running_or_notify_cancel()
        if is_cancelled:
            return
        try:
            result = task_future.result()
            self._run.save(part_name, _encode_array(result))
            stored_future.set_result(result)
        except BaseException as error:  # the error is raised where the result is requested
            stored_future.set_exception(error)


def _decode_array(data: bytes) -> Array:
    """Return the array of numbers in the bytes of an npy file; raise ValueError if there is none."""
    array = np.load(io.BytesIO(data), allow_pickle=False)
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise ValueError(f"expected an array of numbers, got {getattr(array, 'dtype', 'an archive')}")
    return array


def _encode_array(array: Array) -> bytes:
    """Return the bytes of an npy file with an array."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def draft_of(target: Path) -> Path:
    """Return the draft folder of a target."""
    path_with_name = target if target.name else target.absolute()  # the path "." has no name
    return path_with_name.parent / f"{path_with_name.name}.part"


def refuse_finished(target: Path) -> None:
    """Raise OutputExists if the target exists.

    If a process is killed after it has renamed its data to the target, the rest of its draft remains. This function
    removes the rest.
    """
    draft = ResumableRun(target)
    if target.exists() and (draft.folder / "run.json").is_file() and not draft.data.exists():
        draft.remove()
    refuse_existing(target)


@contextmanager
def resume_folder(target: Path, identity: Mapping[str, Any], *, fresh: bool = False) -> Iterator[ResumableRun]:
    """Begin a run, or resume a run that was stopped. The target folder is created when the block ends without an error.

    After an error, the draft is kept for the next run. The draft is removed if no part is finished, or if the same
    error would occur again.

    Args:
        target: Folder that the run writes.
        identity: All settings on which the result depends, as JSON.
        fresh: Whether to delete an earlier draft.

    Yields:
        The draft. The block writes the files of the target into its folder `data`.

    Raises:
        OutputExists: If the target exists, or the draft belongs to a run with other settings or is in use.
        OutputError: If a file cannot be written.
    """
    with resume_parts(target, identity, fresh=fresh) as draft:
        yield draft
        draft.publish()


@contextmanager
def resume_parts(target: Path, identity: Mapping[str, Any], *, fresh: bool = False) -> Iterator[ResumableRun]:
    """Begin or resume a run whose block writes the target itself, for example as a single file.

    The finished parts of the run are stored in a folder beside the target, which is called the draft. The draft is
    removed when the block ends without an error. After an error, the draft is kept for the next run, unless no part is
    finished or the same error would occur again.

    Args:
        target: File or folder that the run writes.
        identity: All settings on which the result depends, as JSON.
        fresh: Whether to delete an earlier draft.

    Yields:
        The draft, which stores the finished parts.

    Raises:
        OutputExists: If the target exists, or the draft belongs to a run with other settings or is in use.
        OutputError: If a file cannot be written.
    """
    refuse_finished(target)
    draft = ResumableRun(target)
    missing_parents = [parent for parent in target.parents if not parent.exists()]
    try:
        identity_as_saved = json.loads(json.dumps(identity))  # with lists in place of tuples, as in the saved file
        with _claim(draft, identity_as_saved, fresh):
            try:
                draft.prepare()
                yield draft
                draft.remove()
            except BaseException as error:
                would_fail_again = isinstance(error, InputError | SolveError | TrainingError)
                if draft.is_empty() or would_fail_again:
                    draft.remove()
                raise
    finally:
        remove_empty(missing_parents)  # they were created for the draft, and are empty if it was removed


@contextmanager
def _claim(draft: ResumableRun, identity: dict[str, Any], fresh: bool) -> Iterator[None]:
    """Lock the draft of a run during the block, and create the draft if necessary.

    The folder of a draft contains a lock file, and a file `run.json` with the settings of the run.

    Args:
        draft: The run.
        identity: Settings of the run. A draft with other settings is refused.
        fresh: Whether an existing draft is removed first.
    """
    folder = draft.folder
    is_draft = (folder / "run.json").is_file()  # any other folder is never removed
    if fresh and is_draft:
        with locked(folder / "lock"):  # refuses a draft that another process is using
            draft.remove()
    is_new = not folder.exists()
    try:
        if is_new:
            # The folder appears with both files at once, even if the process is killed in between.
            with new_folder(folder) as temporary:
                (temporary / "lock").touch()
                write_whole(temporary / "run.json", (json.dumps(identity, indent=2) + "\n").encode())
        with locked(folder / "lock"):
            _check_same_run(folder, identity)
            yield
    except KeyboardInterrupt:
        if is_new and draft.is_empty():  # the user has stopped the run before `resume_parts` could remove the draft
            draft.remove()
        raise


def output_errors(target: Path) -> AbstractContextManager[None]:
    """Convert an OSError that the block raises to an OutputError, whose message states how to resume the run."""
    return as_output_errors(target, f"repeat the command to resume from {draft_of(target)}, or choose another output")


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Lock a folder against other processes during the block. The system unlocks the folder if this process is killed.

    Args:
        path: The folder, or a lock file in the folder.

    Raises:
        OutputExists: If another process has locked the folder.
    """
    if path.is_dir():
        folder = path
        descriptor = os.open(path, os.O_RDONLY)
    else:
        folder = path.parent
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises an error at once if it is locked
        except BlockingIOError as error:
            raise OutputExists(
                f"another process is at work in {folder}; wait for it, or choose another output"
            ) from error
        yield
    finally:
        os.close(descriptor)  # also unlocks the folder


def _check_same_run(folder: Path, identity: dict[str, Any]) -> None:
    """Check that a draft belongs to a run with the same settings.

    Args:
        folder: Folder of the draft.
        identity: Settings of the present run.

    Raises:
        OutputExists: If the settings differ or cannot be read.
    """
    try:
        saved = read_json(folder / "run.json", "the settings of a run", InputError, dict[str, Any])
    except InputError as error:
        raise OutputExists(
            f"{folder} is in the way: it holds no run.json that can be read; choose another output or remove it"
        ) from error
    # The comparison of texts also distinguishes 1, 1.0 and true, which are equal in Python.
    if json.dumps(saved, sort_keys=True) != json.dumps(identity, sort_keys=True):
        differences = "; ".join(_differences(saved, identity))
        raise OutputExists(
            f"{folder} holds the unfinished run of other settings: {differences}; finish that with its own command, "
            "choose another output, or begin again (--fresh, which throws it away)"
        )


def _differences(saved: Any, current: Any, name: str = "") -> Iterator[str]:
    """Yield descriptions of the settings in which two runs differ.

    Only the innermost settings that differ are described. A setting that one of the runs does not have counts as None.

    Args:
        saved: Settings of the unfinished run, or a part of them.
        current: Settings of the present run, or the same part of them.
        name: Name of this part; empty for all settings.
    """
    if isinstance(saved, dict) and isinstance(current, dict):
        for key in sorted(saved.keys() | current.keys()):
            if saved.get(key) != current.get(key):
                inner_name = f"{name}.{key}" if name else key
                yield from _differences(saved.get(key), current.get(key), inner_name)
    else:
        yield f"{name or 'run.json'} is {cut(str(saved))} there, {cut(str(current))} here"
