"""The unit of a board's clock, from its ticks per second of the host."""

UNITS_HZ = {"t_s": 1.0, "t_ms": 1e3, "t_us": 1e6}
"""Ticks per second of a clock by the name of its field, Hz."""

USUAL_HZ = (100.0, 1e4, 1e5, 1024.0, 32768.0, 31250.0, 500e3, 2e6, 4e6, 8e6, 16e6)
"""Other rates at which clocks of boards tick, Hz."""

TOLERANCE = 0.06
"""Largest relative difference of a clock's rate from a usual one, dimensionless: frames arrive in bursts."""


def is_usual(ticks_Hz: float) -> bool:
    """Whether clocks of boards tick at this rate."""
    return any(abs(ticks_Hz / usual_Hz - 1.0) < TOLERANCE for usual_Hz in (*UNITS_HZ.values(), *USUAL_HZ))


def clock_name(ticks_Hz: float) -> tuple[str, float]:
    """The name of a clock's field, and the value of one tick in the unit that the name says.

    A rate that no board has is taken as it was measured, to three digits.
    """
    for name, unit_Hz in UNITS_HZ.items():
        if abs(ticks_Hz / unit_Hz - 1.0) < TOLERANCE:
            return name, 1.0
    for usual_Hz in USUAL_HZ:
        if abs(ticks_Hz / usual_Hz - 1.0) < TOLERANCE:
            return "t_us", 1e6 / usual_Hz
    return "t_us", float(f"{1e6 / ticks_Hz:.3g}")


def text_clock_name(ticks_Hz: float) -> str | None:
    """The name of a clock in text, which has no scale; None for another unit."""
    name, scale = clock_name(ticks_Hz)
    return name if scale == 1.0 else None
