"""Check of the range of a quantity, and a function that rounds numbers for files."""

import math

from isocharge.common.errors import InputError

OTHER_UNITS = {"mm": ("m", 1e3), "um": ("mm", 1e3), "MPa": ("Pa", 1e-6), "GPa": ("MPa", 1e-3)}
"""For some units, another unit in which a value is easily given by mistake, and the factor that converts the value."""


def tidy(value: float) -> float:
    """Round a number to twelve significant digits, in order to remove the rounding errors of unit conversions."""
    return float(f"{value:.12g}")


def check_range(what: str, value: float, allowed: tuple[float, float], unit: str, error: type[InputError]) -> None:
    """Raise an error if a quantity is infinite or outside its accepted range.

    If the value was probably given in a unit of `OTHER_UNITS`, the message converts it.

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
    other_unit, factor = OTHER_UNITS.get(unit, ("", math.nan))
    if low <= factor * value <= high:
        hint = f"; {value:.6g} {other_unit} are {factor * value:.6g} {unit}"
    expected = f"at least {low:g}" if high == math.inf else f"{low:g} to {high:g}"
    space = " " if unit else ""
    raise error(f"{what}: expected {expected}{space}{unit}, got {value:.6g}{space}{unit}{hint}")
