"""Gaps, repeats and restarts in the numbers of frames."""

from isocharge.serve.flags import GAP, REPEAT, RESTART

SEQ_MODULUS = 1 << 16
"""Number at which a counter of 16 bits wraps to 0."""


class SequenceGaps:
    """Follows the frame numbers.

    Attributes:
        lost: Frames missing between those that came.
        repeated: Frames with the number of the one before.
        restarts: Times that the numbers went back, as after a reset of the device; frames lost then are not counted.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.repeated = 0
        self.restarts = 0
        self._last: int | None = None

    def forget(self) -> None:
        """Start over: the next number is the first one of a new connection, and no gap."""
        self._last = None

    def update(self, seq: int | None, modulus: int = SEQ_MODULUS) -> tuple[str, ...]:
        """Count the next frame, and give its flags (see `isocharge.serve.flags`).

        Args:
            seq: Its number; None if the format has none.
            modulus: The number at which `seq` wraps to 0.
        """
        if seq is None:
            return ()
        step = 1 if self._last is None else (seq - self._last) % modulus
        self._last = seq
        if step == 1:
            return ()
        if step == 0:
            self.repeated += 1
            return (REPEAT,)
        if step >= modulus // 2:
            self.restarts += 1
            return (RESTART,)
        self.lost += step - 1
        return (GAP,)
