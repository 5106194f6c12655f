"""Check of the range of a quantity, and a function that rounds numbers for files."""

import math

from isocharge.common.errors import InputError


def tidy(value: float) -> float:
    """Round a number to twelve significant digits, in order to remove the rounding errors of unit conversions."""
    return float(f"{value:.12g}")


def check_range(what: str, value: float, allowed: tuple[float, float], unit: str, error: type[InputError]) -> None:
    """Raise an error if a quantity is infinite or outside its accepted range.

    The message converts a length that was probably given in metres, and a stress that was probably given in pascals.

    Args:
        what: Name of the quantity in the error message.
        value: Value to be checked. NaN is outside every range.
        allowed: Smallest and largest accepted value.
        unit: Unit of the value, such as "mm" or "MPa".
        error: Class of the error that is raised.

    Raises:
        InputError: If the value is not accepted. The class of the error is `error`.
    """
    low, high = allowed
    if low <= value <= high and math.isfinite(value):
        return
    hint = ""
    if unit == "mm" and 0.0 < value < low:
        hint = f"; {value:.6g} m are {1e3 * value:.6g} mm"
    if unit == "MPa" and high < value < math.inf:
        hint = f"; {value:.6g} Pa are {1e-6 * value:.6g} MPa"
    expected = f"at least {low:g}" if high == math.inf else f"{low:g} to {high:g}"
    space = " " if unit else ""
    raise error(f"{what}: expected {expected}{space}{unit}, got {value:.6g}{space}{unit}{hint}")
