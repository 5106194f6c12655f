"""Gaps, repeats and restarts in the numbers of frames, and where a counter in text wraps."""

from collections.abc import Iterable

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


class CounterWrap:
    """The number at which a counter in text wraps to 0: text does not say how wide a counter is.

    A counter that falls has wrapped if all it ever showed is below a usual modulus, and the step modulo that is no
    larger than its steps before. Otherwise it has begun anew.
    """

    def __init__(self, usual: Iterable[int], modulus: int, most_steps: int) -> None:
        """Set up the watch.

        Args:
            usual: Moduli that boards use, smallest first.
            modulus: That of a counter which has not wrapped yet.
            most_steps: Largest step over a wrap, in steps before.
        """
        self._usual, self._modulus, self._most_steps = tuple(usual), modulus, most_steps
        self._last: int | None = None
        self._step, self._largest = 1, 0

    def update(self, value: int | None) -> int:
        """Take the next value, None where a connection ends, and give the modulus as far as it is known."""
        last, self._last = self._last, value
        if value is None or last is None:
            return self._modulus
        if value < last:
            most = self._most_steps * self._step
            fits = (m for m in self._usual if self._largest < m and (value - last) % m <= min(most, m // 2))
            self._modulus = next(fits, self._modulus)
        elif value > last:
            self._step = value - last
        self._largest = max(self._largest, value)
        return self._modulus
