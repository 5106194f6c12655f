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
import os
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from isocharge.errors import IsochargeError, OutputError, OutputExists, SolveError
from isocharge.files import new_folder, refuse_existing, sha256_of, write_whole

Warn = Callable[[str], object]
"""Told what a person should know."""


class Draft:
    """Finished parts of a run; made by `open_draft`.

    Attributes:
        folder: The draft itself.
        data: Becomes the target.
    """

    def __init__(self, folder: Path, warn: Warn) -> None:
        self.folder, self.data, self._warn = folder, folder / "data", warn
        self._parts = folder / "parts"

    def save(self, name: str, data: bytes, *, final: bool = False) -> None:
        """Keep a finished part; a `final` one belongs to the target."""
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
        for folder in (self._parts, self.data):
            folder.mkdir(exist_ok=True)
            for torn in folder.glob(".*.draft"):
                torn.unlink()


def draft_of(target: Path) -> Path:
    """Where the draft of a target lies."""
    return target.with_name(f"{target.name}.part")


@contextmanager
def open_draft(
    target: Path, identity: Mapping[str, Any], *, fresh: bool = False, warn: Warn = warnings.warn
) -> Iterator[Draft]:
    """Begin a run, or go on with one that was stopped; the target appears when the block ends well.

    Args:
        target: The folder to make.
        identity: All that decides about the result, as JSON can hold it.
        fresh: Throw an earlier draft away.
        warn: Told of damaged parts.

    Yields:
        The draft; fill `data`. If the block fails the draft stays, unless it holds nothing yet or the work itself is
        impossible.

    Raises:
        OutputExists: If the target is already there, or the draft is another run's or in use.
        OutputError: If the file system refuses; the draft stays.
    """
    folder = draft_of(target)
    if target.exists() and (folder / "run.json").is_file() and not (folder / "data").exists():
        shutil.rmtree(folder, ignore_errors=True)  # the target was finished, and its draft not yet removed
    refuse_existing(target)
    missing = [parent for parent in target.parents if not parent.exists()]
    try:
        with _claimed(folder, json.loads(json.dumps(identity)), fresh) as lock, _locked(lock, folder):
            draft = Draft(folder, warn)
            draft.tidy()
            try:
                yield draft
            except BaseException as error:
                if draft.is_empty() or (isinstance(error, ValueError | SolveError) and isinstance(error, IsochargeError)):
                    shutil.rmtree(folder, ignore_errors=True)
                raise
            _publish(draft, target)
    except OSError as error:
        if isinstance(error, IsochargeError):
            raise
        kept = f"what is done is kept in {folder}, and the same command goes on" if folder.exists() else "nothing is left"
        raise OutputError(f"{target} cannot be written: {error.strerror or error}; {kept}") from error
    finally:
        if not folder.exists() and not target.exists():
            for parent in missing:
                _remove_empty(parent)


@contextmanager
def _claimed(folder: Path, identity: dict[str, Any], fresh: bool) -> Iterator[Path]:
    """The lock file of the draft that belongs to this run, made if there is none."""
    yield folder / "lock"
