"""Runs of long computations that can be stopped and resumed.

The file or folder that a run writes is called the target. The finished parts of a run are stored in the draft, which is
a folder next to the target. The draft of the target `presses` has the following files.

    presses.part/
        run.json              settings of the run; a run with other settings does not use the draft
        lock                  locked by the running process; the operating system unlocks it if the process is killed
        parts/<name>          finished part
        parts/<name>.sha256   checksum of the finished part
        data/<name>           finished part that is a file of the target; its checksum is also in parts/

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
    """Draft of a run, which stores the finished parts of this run. `resume_folder` and `resume_parts` create it.

    Attributes:
        target: File or folder that the run writes.
        folder: Folder of the draft, which contains the parts until the run is finished.
        data: Folder in the draft that `publish` renames to the target.
    """

    def __init__(self, target: Path) -> None:
        """Store the paths. Nothing is created.

        Args:
            target: File or folder that the run writes.
        """
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
            OutputError: If the part cannot be written. Parts that were saved before remain unchanged.
        """
        # The checksum is written last. A part without a checksum is therefore not finished.
        with output_errors(self.target):
            write_whole(self._path(name, final), data)
            write_whole(self._parts / f"{name}.sha256", sha256_of(data).encode())

    def load(self, name: str, decode: Callable[[bytes], Content], *, final: bool = False) -> Content | None:
        """Load a part of the run that `save` has stored, and check its checksum.

        Args:
            name: Name of the part.
            decode: Function that converts the bytes of the part to its content. If the part is damaged, the function
                may raise any exception.
            final: Whether the part is a file of the target, and not only an intermediate result.

        Returns:
            The content; None if the part is not finished. If the part is damaged, a warning is logged, and the result
            is None.
        """
        # A part without a checksum is not finished, because `save` writes the checksum last.
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
        """Return an executor that stores the result of each task as a part of the run.

        If an earlier run has stored the result of a task, the result is loaded instead. The results must be arrays of
        numbers. The parts are numbered in the order in which the tasks are submitted. A resumed run must therefore
        submit the same tasks in the same order.

        Args:
            name: Text with which the names of the parts begin.
            executor: Executor that computes the tasks. If None, the tasks are computed in this process.
        """
        return _StoringExecutor(self, name, executor)

    def is_empty(self) -> bool:
        """Return whether the draft contains no finished part."""
        return not any(self._parts.glob("*.sha256"))

    def _path(self, name: str, final: bool) -> Path:
        """Return the path of the file that stores a part of the run; see `save` for the arguments."""
        return (self.data if final else self._parts) / name

    def prepare(self) -> None:
        """Create the folders of the draft, and remove incomplete files that a killed process has left.

        The draft is the folder that stores the finished parts of the run.

        Raises:
            OutputError: If a folder cannot be created.
        """
        with output_errors(self.target):
            for folder in (self._parts, self.data):
                folder.mkdir(exist_ok=True)
                for incomplete_file in folder.glob(".*.draft"):  # the temporary names of `write_whole`
                    incomplete_file.unlink()

    def publish(self) -> None:
        """Rename the folder `data` of the draft to the target, and remove the rest of the draft.

        The draft is the folder that stores the finished parts of the run. The target is the folder that the run writes.
        The folders are flushed to disk, so that the files and their new names survive a power failure.

        Raises:
            OutputExists: If the target exists.
            OutputError: If the folder cannot be renamed.
        """
        with output_errors(self.target):
            flush_to_disk(self.data)
            refuse_existing(self.target)
            self.data.rename(self.target)
            with suppress(OSError):  # the target is complete even if this fails
                flush_to_disk(self.target.parent)
        self.remove()

    def remove(self) -> None:
        """Remove the folder of the draft with all parts."""
        shutil.rmtree(self.folder, ignore_errors=True)


class _StoringExecutor(Executor):
    """Executor that stores the result of each task as a part of a run; see `ResumableRun.storing_executor`."""

    def __init__(self, run: ResumableRun, name: str, executor: Executor | None) -> None:
        """Store the arguments, which `ResumableRun.storing_executor` describes.

        Args:
            run: Run that stores the results.
            name: Text with which the names of the parts begin.
            executor: Executor that computes the tasks. If None, the tasks are computed in this process.
        """
        self._run = run
        self._name = name
        self._executor = executor
        self._submitted_count = 0

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit a task whose result is stored as a part of the run, and return the future of the stored result.

        There are three cases. If an earlier run has stored the result, the result is loaded. Otherwise, the executor
        that was given to the constructor computes the task. Without an executor, this method computes the task itself.

        Args:
            function: Function that computes the result, an array of numbers.
            args: Positional arguments of the function.
            kwargs: Keyword arguments of the function.
        """
        part_name = f"{self._name}-{self._submitted_count:04d}.npy"  # parts are numbered in the order of submission
        self._submitted_count += 1
        stored_future: Future[Any] = Future()  # it is done when the result is stored
        loaded_result = self._run.load(part_name, _decode_array)
        if loaded_result is not None:
            stored_future.set_result(loaded_result)
        elif self._executor is None:
            result = function(*args, **kwargs)
            self._run.save(part_name, _encode_array(result))
            stored_future.set_result(result)
        else:
            task_future = self._executor.submit(function, *args, **kwargs)
            # When the task is done, store its result. The argument of a callback is the finished future, which neither
            # of the two callbacks needs.
            task_future.add_done_callback(lambda _: self._store(part_name, task_future, stored_future))
            # If the caller cancels the returned future, also cancel the task. The callback is also called after the
            # result was stored. It has no effect then, because a finished task cannot be cancelled.
            stored_future.add_done_callback(lambda _: task_future.cancel())
        return stored_future

    def _store(self, part_name: str, task_future: Future[Any], stored_future: Future[Any]) -> None:
        """Store the result of a task, and set the result of the future that `submit` has returned.

        If computing or storing the result has failed, the exception is set instead.

        Args:
            part_name: Name of the part as which the result is stored.
            task_future: Future of the task, which is done or cancelled.
            stored_future: Future that `submit` has returned.
        """
        if task_future.cancelled():
            stored_future.cancel()

        # The caller may also have cancelled the returned future. Otherwise, this call marks the future as running, so
        # that it cannot be cancelled any more while the result is stored.
        is_cancelled = not stored_future.set_running_or_notify_cancel()
        if is_cancelled:
            return
        try:
            result = task_future.result()
            self._run.save(part_name, _encode_array(result))
            stored_future.set_result(result)
        except BaseException as error:  # `stored_future.result()` raises it again
            stored_future.set_exception(error)


def _decode_array(data: bytes) -> Array:
    """Convert the bytes of an npy file into the array of numbers that the file contains.

    Args:
        data: Bytes of the npy file.

    Raises:
        ValueError: If the bytes are not an npy file, or the array does not contain numbers.
    """
    array = np.load(io.BytesIO(data), allow_pickle=False)
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise ValueError(f"expected an array of numbers, got {getattr(array, 'dtype', 'an archive')}")
    return array


def _encode_array(array: Array) -> bytes:
    """Return the bytes of an npy file that contains the array."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def draft_of(target: Path) -> Path:
    """Return the path of the draft for the target of a run."""
    path_with_name = target if target.name else target.absolute()  # the path "." has no name
    return path_with_name.parent / f"{path_with_name.name}.part"


def prepare_target(target: Path) -> None:
    """Remove a draft that an ended run has left behind, and check that the target of a new run does not exist.

    A draft is a folder that stores the finished parts of a run. At the end of the run, the folder `data` of the draft
    is renamed to the target, and the draft is removed. If the process is killed between these two steps, the draft
    remains.

    Args:
        target: File or folder that the run writes.

    Raises:
        OutputExists: If the target exists.
    """
    draft = ResumableRun(target)
    is_draft = (draft.folder / "run.json").is_file()  # a folder that is no draft is never removed
    is_data_renamed = target.exists() and not draft.data.exists()
    if is_draft and is_data_renamed:
        draft.remove()
    refuse_existing(target)


@contextmanager
def resume_folder(target: Path, identity: Mapping[str, Any], *, fresh: bool = False) -> Iterator[ResumableRun]:
    """Begin or resume a run in the `with` block. At the end of the block, the draft becomes the target folder.

    The draft is a folder next to the target that stores the finished parts of the run. If the block raises an
    exception, the draft is kept for the next run. However, the draft is removed if it contains no finished part, or if
    the next run would fail with the same error.

    Args:
        target: Folder that the run writes.
        identity: All settings on which the result depends. They must be values that JSON can represent.
        fresh: Whether a draft of an earlier run is removed first.

    Yields:
        The draft. The block writes the files of the target into the folder `data` of the draft.

    Raises:
        OutputExists: If the target exists, or the draft belongs to a run with other settings or is in use.
        OutputError: If a file cannot be written.
    """
    with resume_parts(target, identity, fresh=fresh) as draft:
        yield draft
        draft.publish()


@contextmanager
def resume_parts(target: Path, identity: Mapping[str, Any], *, fresh: bool = False) -> Iterator[ResumableRun]:
    """Begin or resume a run in the `with` block. The block itself writes the target, for example as a single file.

    The draft is a folder next to the target that stores the finished parts of the run. The draft is removed at the end
    of the block. If the block raises an exception, the draft is kept, so that the next run can use the finished parts.
    However, the draft is removed if it contains no finished part, or if the next run would fail with the same error.

    Args:
        target: File or folder that the run writes.
        identity: All settings on which the result depends. They must be values that JSON can represent.
        fresh: Whether a draft of an earlier run is removed first.

    Yields:
        The draft, which stores the finished parts.

    Raises:
        OutputExists: If the target exists, or the draft belongs to a run with other settings or is in use.
        OutputError: If a file cannot be written.
    """
    prepare_target(target)
    draft = ResumableRun(target)
    missing_parents = [parent for parent in target.parents if not parent.exists()]
    try:
        identity_as_saved = json.loads(json.dumps(identity))  # tuples become lists, as in the saved file
        with _claim(draft, identity_as_saved, fresh):
            try:
                draft.prepare()
                yield draft
                draft.remove()
            except BaseException as error:
                # These errors depend only on the settings, which are the same in the next run. An InputError may be due
                # to a file that can be mended, and must not cost the finished parts.
                would_fail_again = isinstance(error, SolveError | TrainingError)
                if draft.is_empty() or would_fail_again:
                    draft.remove()
                raise
    finally:
        remove_empty(missing_parents)  # they were created for the draft, and are empty if the draft was removed


@contextmanager
def _claim(draft: ResumableRun, identity: dict[str, Any], fresh: bool) -> Iterator[None]:
    """Lock the draft of a run for the `with` block, and create the draft if it does not exist.

    The draft is a folder that stores the finished parts of the run. It contains a lock file, and the file `run.json`
    with the settings of the run.

    Args:
        draft: The draft.
        identity: Settings of the run. A draft with other settings is refused.
        fresh: Whether an existing draft is removed first.

    Raises:
        OutputExists: If the draft belongs to a run with other settings, or is used by another process.
        OutputError: If the draft cannot be created.
    """
    folder = draft.folder
    is_draft = (folder / "run.json").is_file()  # any other folder is never removed
    if fresh and is_draft:
        with locked(folder / "lock"):  # raises an error if another process is using the draft
            draft.remove()
    is_new = not folder.exists()
    try:
        if is_new:
            # Create the folder under a temporary name, so that it never exists without both files, even if the process
            # is killed.
            with new_folder(folder) as temporary_folder:
                (temporary_folder / "lock").touch()
                write_whole(temporary_folder / "run.json", (json.dumps(identity, indent=2) + "\n").encode())
        with locked(folder / "lock"):
            _check_same_run(folder, identity)
            yield
    except KeyboardInterrupt:
        if is_new and draft.is_empty():  # the interruption may have occurred before `resume_parts` entered its `try`
            draft.remove()
        raise


def output_errors(target: Path) -> AbstractContextManager[None]:
    """Return a context manager that converts an OSError to an OutputError. Its message states how to resume the run.

    Args:
        target: File or folder that the run writes.
    """
    return as_output_errors(target, f"repeat the command to resume from {draft_of(target)}, or choose another output")


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Lock a folder for the `with` block, so that no other process can lock the folder.

    If the given path does not exist, it is created as a lock file. The operating system unlocks the folder if this
    process is killed.

    Args:
        path: The folder, or a lock file in the folder.

    Raises:
        OutputExists: If another process has locked the folder.
    """
    if path.is_dir():
        folder = path
        descriptor = os.open(path, os.O_RDONLY)  # a folder cannot be opened for writing
    else:
        folder = path.parent
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # raises an error at once instead of waiting
        except BlockingIOError as error:
            raise OutputExists(
                f"another process is at work in {folder}; wait for it, or choose another output"
            ) from error
        yield
    finally:
        os.close(descriptor)  # also unlocks the folder


def _check_same_run(folder: Path, identity: dict[str, Any]) -> None:
    """Check that a draft belongs to a run with the same settings as the present run.

    The draft of a run is a folder that stores the finished parts of the run, and its settings in `run.json`.

    Args:
        folder: Folder of the draft.
        identity: Settings of the present run.

    Raises:
        OutputExists: If the settings in the draft differ or cannot be read.
    """
    try:
        saved_identity = read_json(folder / "run.json", "the settings of a run", InputError, dict[str, Any])
    except InputError as error:
        raise OutputExists(
            f"{folder} is in the way: it holds no run.json that can be read; choose another output or remove it"
        ) from error
    # The settings are compared as texts, because Python values such as 1, 1.0 and True would be equal.
    if json.dumps(saved_identity, sort_keys=True) != json.dumps(identity, sort_keys=True):
        differences = "; ".join(_differences(saved_identity, identity))
        raise OutputExists(
            f"{folder} holds the unfinished run of other settings: {differences}; finish that with its own command, "
            "choose another output, or begin again (--fresh, which throws it away)"
        )


def _differences(saved: Any, current: Any, name: str = "") -> Iterator[str]:
    """Yield a description of each setting in which an unfinished run differs from the present run.

    If a setting is a table, the settings in the table are compared one by one. If one of the runs does not have a
    setting, the setting counts as None.

    Args:
        saved: All settings of the unfinished run as a dictionary, or the value of one setting.
        current: All settings of the present run as a dictionary, or the value of the same setting.
        name: Name of the setting that is compared; empty for all settings.
    """
    if isinstance(saved, dict) and isinstance(current, dict):
        for key in sorted(saved.keys() | current.keys()):
            if saved.get(key) != current.get(key):
                name_with_table = f"{name}.{key}" if name else key
                yield from _differences(saved.get(key), current.get(key), name_with_table)
    else:
        yield f"{name or 'run.json'} is {cut(str(saved))} there, {cut(str(current))} here"
