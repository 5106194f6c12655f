"""The state of a training run, saved every few seconds, so that a killed run goes on and ends with the same weights.

Each stage has a part in the run's draft (`isocharge.common.resumable_run`): written whole, with a checksum.
"""

import io
import time
from collections.abc import Callable
from typing import Any

import torch

from isocharge.common.resumable_run import ResumableRun

EVERY_S = 3.0
"""Seconds between two writes of a running stage."""


class Checkpoint:
    """Saves states of stages in a draft, or nowhere.

    Args:
        draft: Where; nowhere if absent.
        clock: Seconds.
    """

    def __init__(self, draft: ResumableRun | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._draft, self._clock = draft, clock
        self._written = clock()

    def load(self, stage: str) -> Any:
        """The state that was saved last, or None."""
        return self._draft.load_as(stage, _state) if self._draft else None

    def save(self, stage: str, state: Callable[[], Any], *, now: bool = False) -> None:
        """Save a state of tensors, numbers and texts; unless `now`, only if `EVERY_S` seconds have passed.

        Raises:
            OutputError: If the file system refuses; what was saved before stays.
        """
        if self._draft is None or not (now or self._clock() - self._written >= EVERY_S):
            return
        buffer = io.BytesIO()
        torch.save(state(), buffer)
        self._draft.save(stage, buffer.getvalue())
        self._written = self._clock()


def _state(data: bytes) -> Any:
    """The state in the bytes of a part; nothing in them is executed."""
    return torch.load(io.BytesIO(data), weights_only=True)
