"""Noise and amplifiers by the name of their level - clean, reference, bench, surgery - or from a TOML file."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_type_hints

from msgspec import defstruct, structs

from isocharge.common.errors import InputError, error_prefix
from isocharge.common.structs import NotNegative, Settings, read_toml
from isocharge.simulate.measuring_chain.amplifier import Amplifier
from isocharge.simulate.measuring_chain.noise import NoiseModel

NOISE_LEVELS = {
    "clean": NoiseModel("clean", 0.0, 0.0),
    "reference": NoiseModel("reference", 1.0, 2e-3),
    "bench": NoiseModel("bench", 0.3, 0.0),
    "surgery": NoiseModel("surgery", 1.0, 0.0),
}
"""Noise levels by name. For `bench` and `surgery` this is the memoryless part of their amplifiers below."""

BENCH = Amplifier(
    noise=NOISE_LEVELS["bench"],
    tau=10.0,
    tau_mismatch=0.05,
    gain_mismatch=0.01,
    hum=1.0,
    offset=2.0,
    bias=0.5,
    temperature_rms=0.05,
    limit=1500.0,
    bits=16,
)

AMPLIFIER_LEVELS = {
    "clean": Amplifier(noise=NOISE_LEVELS["clean"]),
    "reference": Amplifier(noise=NOISE_LEVELS["reference"]),
    "bench": BENCH,
    "surgery": replace(BENCH, noise=NOISE_LEVELS["surgery"], hum=5.0, step=0.5),
}
"""Amplifiers by the same names."""

KEYS = {
    "tau": "tau_s",
    "hum": "hum_pC",
    "hum_frequency": "hum_Hz",
    "offset": "offset_pC",
    "bias": "bias_pA",
    "pyro": "pyro_pC_per_K",
    "temperature_rms": "temperature_rms_K",
    "temperature_time": "temperature_time_s",
    "step": "temperature_step_K",
    "step_at": "temperature_step_at_s",
    "step_time": "temperature_step_time_s",
    "step_for": "temperature_step_for_s",
    "film_time": "film_time_s",
    "limit": "limit_pC",
}
"""Keys of the file that are not called as the attributes of `Amplifier`."""

AmplifierFile = defstruct(
    "AmplifierFile",
    [
        ("like", Literal["clean", "reference", "bench", "surgery"], "clean"),
        ("white_pC", NotNegative | None, None),
        ("proportional", NotNegative | None, None),
        *(
            (name, kind | None, None)
            for name, kind in get_type_hints(Amplifier, include_extras=True).items()
            if name != "noise"
        ),
    ],
    bases=(Settings,),
    frozen=True,
    rename=KEYS,
)
"""The file: noise, and the attributes of `Amplifier` with their bounds; what is None is that of the level `like`."""


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
    file = read_toml(Path(level), "the description of noise", InputError, AmplifierFile)
    given: dict[str, Any] = {name: value for name, value in structs.asdict(file).items() if value is not None}
    like = AMPLIFIER_LEVELS[given.pop("like")]
    white, gain = given.pop("white_pC", like.noise.white), given.pop("proportional", like.noise.gain)
    with error_prefix(f"{level}: ", InputError):
        return replace(like, noise=NoiseModel(Path(level).stem, white, gain), **given)


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
