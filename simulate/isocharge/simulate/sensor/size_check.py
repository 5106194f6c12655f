"""Sizes: those that cannot be, or were plainly given in metres and pascals, are refused; others are written tidily."""

import math

from isocharge.common.errors import InputError


def tidy(value: float) -> float:
    """Without the last digits that unit conversion leaves behind."""
    return float(f"{value:.12g}")


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
