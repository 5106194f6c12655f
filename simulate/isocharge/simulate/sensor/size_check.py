"""Refusal of sizes that were plainly given in metres and pascals."""

from isocharge.common.errors import InputError


def check_millimetres(what: str, value: float, least: float, error: type[InputError]) -> None:
    """Refuse a length (mm) below the smallest that can be meant; `what` is that long, for the message."""
    if value < least:
        raise error(
            f"{what}: expected at least {least:g} mm, got {value:.6g} mm; {value:.6g} m are {1e3 * value:.6g} mm"
        )


def check_megapascals(what: str, value: float, most: float, error: type[InputError]) -> None:
    """Refuse a stress (MPa) above the largest that can be meant."""
    if value > most:
        raise error(
            f"{what}: expected at most {most:g} MPa, got {value:.6g} MPa; {value:.6g} Pa are {1e-6 * value:.6g} MPa"
        )
