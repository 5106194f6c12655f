"""A run that can be killed and go on: its finished parts are kept next to the folder that it will write.

    presses.part/
        run.json           identity of the run: another run does not touch the folder
        lock               held by the process at work; released by the system if that is killed
        parts/<name>       finished work, and <name>.sha256
        data/<name>        what becomes the folder in the end; its checksums are in parts/

A part counts only if its checksum exists and matches; all other parts are computed again.
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
    new_folder,
    read_whole,
    refuse_existing,
    remove_empty,
    sha256_of,
    sync_folder,
    write_whole,
)
from isocharge.common.structs import read_json

Content = TypeVar("Content")

_log = logging.getLogger(__name__)

MAX_PART_BYTES = 1 << 30
"""Largest part of a run, bytes."""


class ResumableRun:
    """Finished parts of a run; see `resume_folder`.

    Attributes:
        target: The folder that the run writes.
        folder: The draft: the folder that holds the parts until the run is done.
        data: The folder in the draft that becomes the target.
    """

    def __init__(self, target: Path) -> None:
        self.target, self.folder = target, draft_of(target)
        self.data, self._parts = self.folder / "data", self.folder / "parts"

    def save(self, name: str, data: bytes, *, final: bool = False) -> None:
        """Keep a finished part; a `final` one belongs to the target.

        Raises:
            OutputError: If the file system refuses; what was saved before stays.
        """
        with output_errors(self.target):
            write_whole(self._place(name, final), data)
            write_whole(self._parts / f"{name}.sha256", sha256_of(data).encode())

    def load(self, name: str, decode: Callable[[bytes], Content], *, final: bool = False) -> Content | None:
        """A finished part, or None if it must be computed; a damaged part gives a warning and None.

        A part that cannot be decoded is damaged, too, whatever its checksum says.

        Args:
            name: Of the part.
            decode: From its bytes to its content; may raise any error.
            final: Whether it belongs to the target.
        """
        try:
            checksum = read_whole(self._parts / f"{name}.sha256").decode()
        except (OSError, UnicodeDecodeError):
            return None
        path = self._place(name, final)
        try:
            data = read_whole(path, MAX_PART_BYTES)
            if sha256_of(data) != checksum:
                raise ValueError(f"expected sha256 {checksum[:12]}..., got {sha256_of(data)[:12]}...")
            return decode(data)
        except Exception as error:  # decoders of other packages raise what they like
            _log.warning("%s is damaged: %s; computed again", path, cut(str(error) or type(error).__name__))
            return None

    def keeping(self, name: str, executor: Executor | None = None) -> Executor:
        """An executor whose results, arrays of numbers, are parts of the run: those that it has are not computed again.

        Tasks are numbered as they are submitted: a run that goes on must submit the same tasks in the same order.

        Args:
            name: First part of the file names.
            executor: Runs the tasks; None runs them in this process.
        """
        return _Keeping(self, name, executor)

    def is_empty(self) -> bool:
        """Whether no part is finished yet."""
        return not any(self._parts.glob("*.sha256"))

    def _place(self, name: str, final: bool) -> Path:
        return (self.data if final else self._parts) / name

    def prepare(self) -> None:
        """Create the folders, and remove files that a killed process had not finished writing."""
        with output_errors(self.target):
            for folder in (self._parts, self.data):
                folder.mkdir(exist_ok=True)
                for torn in folder.glob(".*.draft"):
                    torn.unlink()

    def publish(self) -> None:
        """Give the data the target's name, in a way that survives a power cut, and remove the draft."""
        with output_errors(self.target):
            sync_folder(self.data)
            refuse_existing(self.target)
            self.data.rename(self.target)
            with suppress(OSError):  # the data are safe; only their name might not outlive a power cut
                sync_folder(self.target.parent)
        self.remove()

    def remove(self) -> None:
        """Remove the draft with all its parts."""
        shutil.rmtree(self.folder, ignore_errors=True)


class _Keeping(Executor):
    """See `ResumableRun.keeping`."""

    def __init__(self, run: ResumableRun, name: str, executor: Executor | None) -> None:
        self._run, self._name, self._executor, self._submitted = run, name, executor, 0

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        part = f"{self._name}-{self._submitted:04d}.npy"
        self._submitted += 1
        kept: Future[Any] = Future()
        if (saved := self._run.load(part, _array)) is not None:
            kept.set_result(saved)
        elif self._executor is None:
            result = function(*args, **kwargs)
            self._run.save(part, _npy(result))
            kept.set_result(result)
        else:
            computed = self._executor.submit(function, *args, **kwargs)
            computed.add_done_callback(lambda _: self._keep(part, computed, kept))
            kept.add_done_callback(lambda _: computed.cancel())
        return kept

    def _keep(self, part: str, computed: Future[Any], kept: Future[Any]) -> None:
        if computed.cancelled():
            kept.cancel()
        if not kept.set_running_or_notify_cancel():
            return
        try:
            result = computed.result()
            self._run.save(part, _npy(result))
            kept.set_result(result)
        except BaseException as error:  # as an executor does: it is raised where the result is taken
            kept.set_exception(error)


def _array(data: bytes) -> Array:
    array = np.load(io.BytesIO(data), allow_pickle=False)
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise ValueError(f"expected an array of numbers, got {getattr(array, 'dtype', 'an archive')}")
    return array


def _npy(array: Array) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    return buffer.getvalue()


def draft_of(target: Path) -> Path:
    """Folder of a target's draft."""
    named = target if target.name else target.absolute()  # "."
    return named.parent / f"{named.name}.part"


def refuse_finished(target: Path) -> None:
    """Raise OutputExists if the target is already there."""
    draft = ResumableRun(target)
    if target.exists() and (draft.folder / "run.json").is_file() and not draft.data.exists():
        draft.remove()  # its process was killed after the target had its name and before the draft was gone
    refuse_existing(target)


@contextmanager
def resume_folder(target: Path, identity: Mapping[str, Any], *, fresh: bool = False) -> Iterator[ResumableRun]:
    """Begin a run, or go on with one that was stopped; the target appears when the block ends well.

    Args:
        target: The folder to write.
        identity: Everything that the result depends on, as JSON.
        fresh: Throw an earlier draft away.

    Yields:
        The draft; fill `data`. If the block fails, the draft stays, unless nothing is finished or the same error would
        come again.

    Raises:
        OutputExists: If the target is already there, or the draft is another run's or in use.
        OutputError: If the file system refuses.
    """
    with resume_parts(target, identity, fresh=fresh) as draft:
        yield draft
        draft.publish()


@contextmanager
def resume_parts(target: Path, identity: Mapping[str, Any], *, fresh: bool = False) -> Iterator[ResumableRun]:
    """Like `resume_folder`, but the block writes the target itself; the draft is removed when the block ends well."""
    refuse_finished(target)
    draft = ResumableRun(target)
    parents = [parent for parent in target.parents if not parent.exists()]
    try:
        with _claim(draft, json.loads(json.dumps(identity)), fresh):
            try:
                draft.prepare()
                yield draft
                draft.remove()
            except BaseException as error:
                if draft.is_empty() or isinstance(error, InputError | SolveError | TrainingError):
                    draft.remove()
                raise
    finally:
        remove_empty(parents)


@contextmanager
def _claim(draft: ResumableRun, identity: dict[str, Any], fresh: bool) -> Iterator[None]:
    """Hold the draft of this run; create it if necessary."""
    folder = draft.folder
    if fresh and (folder / "run.json").is_file():
        with locked(folder / "lock"):
            draft.remove()
    begins = not folder.exists()
    try:
        if begins:
            with new_folder(folder) as new:
                (new / "lock").touch()
                write_whole(new / "run.json", (json.dumps(identity, indent=2) + "\n").encode())
        with locked(folder / "lock"):
            _check_same_run(folder, identity)
            yield
    except KeyboardInterrupt:
        if begins and draft.is_empty():  # stopped before the run had its draft in hand
            draft.remove()
        raise


def output_errors(target: Path) -> AbstractContextManager[None]:
    """Turn the file system's errors into OutputError."""
    return as_output_errors(target, f"the same command goes on with what {draft_of(target)} has, or choose another")


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keep other processes out of a folder, by a file in it or by itself; the system lets go if this one is killed.

    Raises:
        OutputExists: If another process holds it.
    """
    folder = path if path.is_dir() else path.parent
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR | os.O_CREAT)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputExists(
                f"another process is at work in {folder}; wait for it, or choose another output"
            ) from error
        yield
    finally:
        os.close(handle)


def _check_same_run(folder: Path, identity: dict[str, Any]) -> None:
    try:
        saved = read_json(folder / "run.json", "the settings of a run", InputError, dict[str, Any])
    except InputError as error:
        raise OutputExists(
            f"{folder} is in the way: it holds no run.json that can be read; choose another output or remove it"
        ) from error
    if json.dumps(saved, sort_keys=True) != json.dumps(identity, sort_keys=True):
        differences = "; ".join(_differences(saved, identity))
        raise OutputExists(
            f"{folder} holds the unfinished run of other settings: {differences}; finish that with its own command, "
            "choose another output, or begin again (--fresh, which throws it away)"
        )


def _differences(saved: Any, current: Any, name: str = "") -> Iterator[str]:
    if isinstance(saved, dict) and isinstance(current, dict):
        for key in sorted(saved.keys() | current.keys()):
            if saved.get(key) != current.get(key):
                yield from _differences(saved.get(key), current.get(key), f"{name}.{key}" if name else key)
    else:
        yield f"{name or 'run.json'} is {cut(str(saved))} there, {cut(str(current))} here"
