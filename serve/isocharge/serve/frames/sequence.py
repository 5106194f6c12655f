"""Gaps, repeats and restarts in the numbers of frames."""

from isocharge.serve.flags import GAP, REPEAT, RESTART

SEQ_MODULUS = 1 << 16


class SequenceGaps:
    """Follows the frame numbers.

    Attributes:
        lost: Frames that are missing between those that came.
        repeated: Frames with the number of the one before.
        restarts: Times the numbers went back, as after a reset of the device; nothing is known about frames lost there.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.repeated = 0
        self.restarts = 0
        self._last: int | None = None

    def forget(self) -> None:
        """The next number is the first one of a new connection: whatever it is, it is no gap."""
        self._last = None

    def update(self, seq: int | None, modulus: int = SEQ_MODULUS) -> tuple[str, ...]:
        """Count the next frame; the flags that its number earns it (see `isocharge.serve.flags`).

        Args:
            seq: Its number; None if the format has none.
            modulus: The number at which counting begins again.
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
