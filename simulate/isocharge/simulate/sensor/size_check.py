"""Refusal of sizes that cannot be, and of those that were plainly given in metres and pascals."""

import math

from isocharge.common.errors import InputError


def check_length(what: str, value: float, least: float, error: type[InputError]) -> None:
    """Refuse a length (mm) that is not finite or below the smallest that can be meant; `what` is that long."""
    if not least <= value < math.inf:
        metres = f"; {value:.6g} m are {1e3 * value:.6g} mm" if 0.0 < value < least else ""
        raise error(f"{what}: expected at least {least:g} mm, got {value:.6g} mm{metres}")


def check_stress(what: str, value: float, least: float, most: float, error: type[InputError]) -> None:
    """Refuse a stress (MPa) outside what can be meant."""
    if not least <= value <= most:
        pascals = f"; {value:.6g} Pa are {1e-6 * value:.6g} MPa" if most < value < math.inf else ""
        raise error(f"{what}: expected {least:g} to {most:g} MPa, got {value:.6g} MPa{pascals}")
