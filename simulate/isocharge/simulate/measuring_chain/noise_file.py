"""Noise and amplifiers by the name of their level or from a TOML file."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from isocharge.common.errors import InputError
from isocharge.common.tables import Table, read_toml
from isocharge.simulate.measuring_chain.amplifier import Amplifier
from isocharge.simulate.measuring_chain.levels import AMPLIFIER_LEVELS, NOISE_LEVELS
from isocharge.simulate.measuring_chain.noise import NoiseModel

NOT_NEGATIVE: dict[str, Any] = {"least": 0}
POSITIVE: dict[str, Any] = {"above": 0.0}
POSITIVE_OR_INFINITE: dict[str, Any] = {"above": 0.0, "or_infinite": True}
ANY: dict[str, Any] = {}

KEYS: dict[str, tuple[str, dict[str, Any]]] = {
    "tau_s": ("tau", POSITIVE_OR_INFINITE),
    "tau_mismatch": ("tau_mismatch", NOT_NEGATIVE),
    "gain_mismatch": ("gain_mismatch", NOT_NEGATIVE),
    "hum_pC": ("hum", NOT_NEGATIVE),
    "hum_Hz": ("hum_frequency", POSITIVE),
    "offset_pC": ("offset", NOT_NEGATIVE),
    "bias_pA": ("bias", NOT_NEGATIVE),
    "pyro_pC_per_K": ("pyro", NOT_NEGATIVE),
    "temperature_rms_K": ("temperature_rms", NOT_NEGATIVE),
    "temperature_time_s": ("temperature_time", POSITIVE),
    "temperature_step_K": ("step", ANY),
    "temperature_step_at_s": ("step_at", ANY),
    "temperature_step_time_s": ("step_time", POSITIVE),
    "limit_pC": ("limit", POSITIVE_OR_INFINITE),
}
"""Numbers of a TOML file: the attribute of `Amplifier` and the bounds of the number."""

OTHER_KEYS = ("like", "white_pC", "proportional", "bits")


def load_amplifier(level: str) -> Amplifier:
    """An amplifier by the name of its level, or from a TOML file.

        like = "bench"       # optional: the level that missing keys are taken from
        white_pC = 0.5
        tau_s = 1.0          # inf for no leak

    Raises:
        InputError: If there is no such level or file, a key is unknown or not a number in its range, or the converter
            has bits and no limit.
    """
    if level in AMPLIFIER_LEVELS:
        return AMPLIFIER_LEVELS[level]
    if not level.endswith(".toml"):
        raise InputError(f"noise level: expected one of {', '.join(AMPLIFIER_LEVELS)}, or a TOML file, got {level!r}")
    return _amplifier(read_toml(Path(level), "the description of noise", InputError), level)


def _amplifier(values: Mapping[str, Any], where: str) -> Amplifier:
    table = Table(values, where, InputError).only(*KEYS, *OTHER_KEYS)
    like = AMPLIFIER_LEVELS[table.choice("like", tuple(AMPLIFIER_LEVELS), "clean")]
    noise = NoiseModel(
        Path(where).stem,
        table.number("white_pC", like.noise.white, least=0),
        table.number("proportional", like.noise.gain, least=0),
    )
    changes = {attribute: table.number(key, **bounds) for key, (attribute, bounds) in KEYS.items() if key in table}
    try:
        return replace(like, noise=noise, bits=table.whole("bits", like.bits, least=0, most=32), **changes)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def noise_model(level: str) -> NoiseModel:
    """Noise by the name of its level, or from a TOML file, for all that takes charges one by one.

        like = "reference"      # optional: the level that missing keys are taken from, by default "clean"
        white_pC = 0.5
        proportional = 0.001    # standard deviation over charge

    The file may describe a whole measuring chain (`load_amplifier`); only its memoryless part counts here.

    Raises:
        InputError: If there is no such level or file, or a key is unknown or not a number in its range.
    """
    if level in NOISE_LEVELS:
        return NOISE_LEVELS[level]
    return load_amplifier(level).noise
