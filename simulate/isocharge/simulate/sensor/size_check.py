"""Functions that check lengths and stresses, and a function that rounds numbers for files.

The checks also detect lengths that were given in metres, and stresses that were given in pascals.
"""

import math

from isocharge.common.errors import InputError


def tidy(value: float) -> float:
    """Round a number to twelve significant digits, in order to remove the rounding errors of unit conversions."""
    return float(f"{value:.12g}")


def check_length(what: str, value: float, minimum: float, error: type[InputError]) -> None:
    """Raise an error if a length is infinite, or so small that it was probably given in metres.

    Args:
        what: Name of the length in the error message.
        value: Length to be checked, mm.
        minimum: Smallest accepted length, mm.
        error: Class of the error that is raised.

    Raises:
        InputError: If the length is not accepted. The class of the error is `error`.
    """
    if not minimum <= value < math.inf:
        hint = f"; {value:.6g} m are {1e3 * value:.6g} mm" if 0.0 < value < minimum else ""
        raise error(f"{what}: expected at least {minimum:g} mm, got {value:.6g} mm{hint}")


def check_stress(what: str, value: float, minimum: float, maximum: float, error: type[InputError]) -> None:
    """Raise an error if a stress is outside the accepted range.

    Args:
        what: Name of the stress in the error message.
        value: Stress to be checked, MPa.
        minimum: Smallest accepted stress, MPa.
        maximum: Largest accepted stress, MPa.
        error: Class of the error that is raised.

    Raises:
        InputError: If the stress is not accepted. The class of the error is `error`.
    """
    if not minimum <= value <= maximum:
        hint = f"; {value:.6g} Pa are {1e-6 * value:.6g} MPa" if maximum < value < math.inf else ""
        raise error(f"{what}: expected {minimum:g} to {maximum:g} MPa, got {value:.6g} MPa{hint}")
