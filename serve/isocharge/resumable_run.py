"""A run that can be killed and go on: its finished parts, kept beside the folder that it will make.

    presses.part/
        run.json           what the run is: another run does not touch it
        lock               held by the process at work; released by the system if that is killed
        parts/<name>       finished work, and <name>.sha256
        data/<name>        what becomes the folder in the end; its checksums are in parts/

A part counts only once its checksum is there and fits; whatever else is found is made again.
"""

import fcntl
import json
import shutil
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from isocharge.errors import InputError, OutputError, OutputExists, SolveError, TrainingError
from isocharge.files import new_folder, refuse_existing, sha256_of, sync_folder, write_whole
from isocharge.progress import Warn


class ResumableRun:
    """Finished parts of a run; `resume_folder` makes one.

    Attributes:
        target: The folder that the run makes.
        folder: The draft itself.
        data: Becomes the target.
    """

    def __init__(self, target: Path, warn: Warn = warnings.warn) -> None:
        self.target, self.folder, self._warn = target, draft_of(target), warn
        self.data, self._parts = self.folder / "data", self.folder / "parts"

    def save(self, name: str, data: bytes, *, final: bool = False) -> None:
        """Keep a finished part; a `final` one belongs to the target.

        Raises:
            OutputError: If the file system refuses; what was saved before stays.
        """
        with output_errors(self.target):
            write_whole(self._place(name, final), data)
            write_whole(self._parts / f"{name}.sha256", sha256_of(data).encode())

    def load(self, name: str, *, final: bool = False) -> bytes | None:
        """A part that was finished, or None if it has to be made; a damaged one is told of and counts as unmade."""
        try:
            checksum = (self._parts / f"{name}.sha256").read_text()
        except (FileNotFoundError, UnicodeDecodeError):
            return None
        path = self._place(name, final)
        data = path.read_bytes() if path.is_file() else b""
        if sha256_of(data) == checksum:
            return data
        self._warn(f"{path} is damaged: expected sha256 {checksum[:12]}..., got {sha256_of(data)[:12]}...; made again")
        return None

    def is_empty(self) -> bool:
        """Whether nothing is finished yet."""
        return not any(self._parts.glob("*.sha256"))

    def _place(self, name: str, final: bool) -> Path:
        return (self.data if final else self._parts) / name

    def tidy(self) -> None:
        """Make the folders, and remove what a killed process was just writing."""
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
        """Throw it away."""
        shutil.rmtree(self.folder, ignore_errors=True)


def draft_of(target: Path) -> Path:
    """Where the draft of a target lies."""
    return target.with_name(f"{target.name}.part")


def refuse_finished(target: Path) -> None:
    """Raise OutputExists if the target is already there."""
    draft = ResumableRun(target)
    if target.exists() and (draft.folder / "run.json").is_file() and not draft.data.exists():
        draft.remove()  # its process was killed after the target had its name and before the draft was gone
    refuse_existing(target)


@contextmanager
def resume_folder(
    target: Path, identity: Mapping[str, Any], *, fresh: bool = False, warn: Warn = warnings.warn
) -> Iterator[ResumableRun]:
    """Begin a run, or go on with one that was stopped; the target appears when the block ends well.

    Args:
        target: The folder to make.
        identity: All that decides about the result, as JSON can hold it.
        fresh: Throw an earlier draft away.
        warn: Told of damaged parts.

    Yields:
        The draft; fill `data`. If the block fails the draft stays, unless nothing is finished or the error is one that
        would come again.

    Raises:
        OutputExists: If the target is already there, or the draft is another run's or in use.
        OutputError: If the file system refuses.
    """
    with resume_parts(target, identity, fresh=fresh, warn=warn) as draft:
        yield draft
        draft.publish()


@contextmanager
def resume_parts(
    target: Path, identity: Mapping[str, Any], *, fresh: bool = False, warn: Warn = warnings.warn
) -> Iterator[ResumableRun]:
    """As `resume_folder`, but the block makes the target itself; the draft is gone when it ends well."""
    refuse_finished(target)
    draft = ResumableRun(target, warn)
    parents = [parent for parent in target.parents if not parent.exists()]
    try:
        with _claim(draft, json.loads(json.dumps(identity)), fresh):
            try:
                draft.tidy()
                yield draft
                draft.remove()
            except BaseException as error:
                if draft.is_empty() or isinstance(error, InputError | SolveError | TrainingError):
                    draft.remove()
                raise
    finally:
        for parent in parents:
            if parent.is_dir() and not any(parent.iterdir()):
                parent.rmdir()


@contextmanager
def _claim(draft: ResumableRun, identity: dict[str, Any], fresh: bool) -> Iterator[None]:
    """Hold the draft of this run, made if there is none."""
    folder = draft.folder
    if fresh and (folder / "run.json").is_file():
        with _lock(folder):
            draft.remove()
    if not folder.exists():
        with output_errors(draft.target), new_folder(folder) as made:
            (made / "lock").touch()
            write_whole(made / "run.json", (json.dumps(identity, indent=2) + "\n").encode())
    with _lock(folder):
        _check_same_run(folder, identity)
        yield


@contextmanager
def output_errors(target: Path) -> Iterator[None]:
    """Say it in our words if the file system refuses."""
    try:
        yield
    except OSError as error:
        if isinstance(error, OutputExists):
            raise
        cause = error.__cause__ if isinstance(error.__cause__, OSError) else error
        kept = f"what is done is kept in {draft_of(target)}; the same command goes on"
        hint = "choose another output" if ResumableRun(target).is_empty() else kept
        raise OutputError(f"{target} cannot be written: {cause.strerror or cause}; {hint}") from error


@contextmanager
def _lock(folder: Path) -> Iterator[None]:
    """Keep other processes out; the system lets go if this one is killed."""
    with (folder / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise OutputExists(
                f"another process is at work in {folder}; wait for it, or choose another output"
            ) from error
        yield


def _check_same_run(folder: Path, identity: dict[str, Any]) -> None:
    try:
        there = json.loads((folder / "run.json").read_text())
    except (FileNotFoundError, ValueError) as error:
        raise OutputExists(
            f"{folder} is in the way: it holds no run.json that can be read; choose another output or remove it"
        ) from error
    if json.dumps(there, sort_keys=True) != json.dumps(identity, sort_keys=True):
        differences = "; ".join(_differences(there, identity))
        raise OutputExists(
            f"{folder} holds the unfinished run of other settings: {differences}; finish that with its own command, "
            "choose another output, or start anew (--fresh, which throws it away)"
        )


def _differences(there: Any, here: Any, name: str = "") -> Iterator[str]:
    if isinstance(there, dict) and isinstance(here, dict):
        for key in sorted(there.keys() | here.keys()):
            if there.get(key) != here.get(key):
                yield from _differences(there.get(key), here.get(key), f"{name}.{key}" if name else key)
    else:
        yield f"{name or 'run.json'} is {there} there, {here} here"
