"""Noise and amplifiers by the name of their level or from a TOML file."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from isocharge.errors import InputError
from isocharge.simulate.measuring_chain.amplifier import Amplifier
from isocharge.simulate.measuring_chain.levels import AMPLIFIER_LEVELS, NOISE_LEVELS
from isocharge.simulate.measuring_chain.noise import NoiseModel

PICO, UNIT = 1e-12, 1.0

KEYS = {
    "tau_s": ("tau", UNIT),
    "tau_mismatch": ("tau_mismatch", UNIT),
    "gain_mismatch": ("gain_mismatch", UNIT),
    "hum_pC": ("hum", PICO),
    "hum_Hz": ("hum_frequency", UNIT),
    "offset_pC": ("offset", PICO),
    "bias_pA": ("bias", PICO),
    "pyro_pC_per_K": ("pyro", PICO),
    "temperature_rms_K": ("temperature_rms", UNIT),
    "temperature_time_s": ("temperature_time", UNIT),
    "temperature_step_K": ("step", UNIT),
    "temperature_step_at_s": ("step_at", UNIT),
    "temperature_step_time_s": ("step_time", UNIT),
    "limit_pC": ("limit", PICO),
    "bits": ("bits", UNIT),
}
"""Keys of a TOML file: the attribute and what one unit is in SI. Besides: `like`, `white_pC`, `proportional`."""


def load_amplifier(level: str) -> Amplifier:
    """An amplifier by the name of its level, or from a TOML file.

        like = "bench"       # optional: what is not said is as there
        white_pC = 0.5
        tau_s = 1.0

    Raises:
        InputError: If there is no such level or file, or a key is unknown or no number in its range.
    """
    if level in AMPLIFIER_LEVELS:
        return AMPLIFIER_LEVELS[level]
    if not level.endswith(".toml"):
        raise InputError(f"noise level: expected one of {', '.join(AMPLIFIER_LEVELS)}, or a TOML file, got {level!r}")
    try:
        table = tomllib.loads(Path(level).read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{level}: cannot be read as TOML ({error}); expected the description of noise") from error
    return _from_table(table, level)


def _from_table(table: Mapping[str, Any], where: str) -> Amplifier:
    like = AMPLIFIER_LEVELS.get(table.get("like", "clean"))
    if like is None:
        raise InputError(f"{where}: like: expected one of {', '.join(AMPLIFIER_LEVELS)}, got {table['like']!r}")
    for key, value in table.items():
        _check(key, value, where)
    noise = NoiseModel(
        Path(where).stem,
        table.get("white_pC", like.noise.white / PICO) * PICO,
        table.get("proportional", like.noise.gain),
    )
    changes: dict[str, Any] = {KEYS[key][0]: value * KEYS[key][1] for key, value in table.items() if key in KEYS}
    if "bits" in table:
        changes["bits"] = table["bits"]
    return replace(like, noise=noise, **changes)


def _check(key: str, value: Any, where: str) -> None:
    known = {*KEYS, "like", "white_pC", "proportional"}
    if key not in known:
        raise InputError(f"{where}: unknown key {key!r}; expected {', '.join(sorted(known))}")
    signed = {"temperature_step_K", "temperature_step_at_s"}
    positive = {"tau_s", "hum_Hz", "temperature_time_s", "temperature_step_time_s", "limit_pC"}
    number = isinstance(value, int | float) and not isinstance(value, bool) and not math.isnan(value)
    good = key == "like" or (number and (key in signed or value >= 0) and (key not in positive or value > 0))
    if not good or (key == "bits" and value not in range(33)):
        raise InputError(f"{where}: {key}: expected a number in its range, got {value!r}")


def noise_model(level: str) -> NoiseModel:
    """Noise by the name of its level, or from a TOML file, for all that takes charges one by one.

        like = "reference"      # optional: what is not said is as there, otherwise as in "clean"
        white_pC = 0.5
        proportional = 0.001    # standard deviation over charge

    The file may describe a whole measuring chain (`load_amplifier`); what has a memory plays no part here.

    Raises:
        InputError: If there is no such level or file, or a key is unknown or no number in its range.
    """
    if level in NOISE_LEVELS:
        return NOISE_LEVELS[level]

    return load_amplifier(level).noise
