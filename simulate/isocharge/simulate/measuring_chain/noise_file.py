"""Built-in noise models and amplifiers, and functions that read a noise model or an amplifier from a TOML file."""

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
    "measured": NoiseModel("measured", 1.0, 1.5e-2),
    "bench": NoiseModel("bench", 0.3, 0.0),
    "surgery": NoiseModel("surgery", 1.0, 0.0),
}
"""Noise model of each noise level.

The level `reference` is an assumption. The proportional noise of the level `measured` comes from the data set
Tactile_Heatmaps of the University of Genoa: a PVDF channel repeats to at most 2 % at equal force in 1,171 recordings.
For the levels `bench` and `surgery`, the noise model is the part of the amplifier without memory.
"""

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
"""Amplifier of the level `bench`, which is plausible for an electric environment with little interference."""

AMPLIFIER_LEVELS = {
    "clean": Amplifier(noise=NOISE_LEVELS["clean"]),
    "reference": Amplifier(noise=NOISE_LEVELS["reference"]),
    "measured": Amplifier(noise=NOISE_LEVELS["measured"]),
    "bench": BENCH,
    "surgery": replace(BENCH, noise=NOISE_LEVELS["surgery"], hum=5.0, step=0.5),
}
"""Amplifier of each noise level."""

KEY_NAMES = {
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
"""Keys of the TOML file that differ from the names of the attributes of `Amplifier`, because the keys contain the unit.

The dictionary maps the name of each attribute to the key.
"""

AmplifierFile = defstruct(
    "AmplifierFile",
    [
        ("like", Literal["clean", "reference", "measured", "bench", "surgery"], "clean"),
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
    rename=KEY_NAMES,
)
"""Content of the TOML file, which consists of the parameters of the noise and the attributes of `Amplifier`.

The values must be within the bounds of the types of the attributes. If a key is absent, the value of the level `like`
is used.
"""


def load_amplifier(level: str) -> Amplifier:
    """Return the built-in amplifier of a noise level, or an amplifier that is described in a TOML file.

    Example of a file:

        like = "bench"       # optional: level with the values of absent keys
        white_pC = 0.5
        tau_s = 1.0          # inf for no leak

    Args:
        level: Name of a noise level, or path of a TOML file.

    Returns:
        The amplifier. The noise of an amplifier from a file is named after the file.

    Raises:
        InputError: If the level or the file does not exist, if a key is unknown or its value is out of range, or if
            the resolution of the converter is given without a limit.
    """
    if level in AMPLIFIER_LEVELS:
        return AMPLIFIER_LEVELS[level]
    if not level.endswith(".toml"):
        raise InputError(f"noise level: expected one of {', '.join(AMPLIFIER_LEVELS)}, or a TOML file, got {level!r}")
    file = read_toml(Path(level), "the description of noise", InputError, AmplifierFile)
    changes: dict[str, Any] = {name: value for name, value in structs.asdict(file).items() if value is not None}

    # Remove the level and the parameters of the noise, because the remaining keys must be attributes of the amplifier.
    similar_amplifier = AMPLIFIER_LEVELS[changes.pop("like")]
    white = changes.pop("white_pC", similar_amplifier.noise.white)
    gain = changes.pop("proportional", similar_amplifier.noise.gain)
    name = Path(level).stem
    with error_prefix(f"{level}: ", InputError):
        noise = NoiseModel(name, white, gain)
        return replace(similar_amplifier, noise=noise, **changes)


def noise_model(level: str) -> NoiseModel:
    """Return the built-in noise model of a level, or a noise model that is described in a TOML file.

    If the file describes a complete measuring chain, only the noise that does not depend on earlier readings is
    returned.

    Example of a file:

        like = "reference"      # optional: level with the values of absent keys, by default "clean"
        white_pC = 0.5
        proportional = 0.001    # standard deviation divided by the charge

    Args:
        level: Name of a noise level, or path of a TOML file.

    Raises:
        InputError: If the level or the file does not exist, if a key is unknown or its value is out of range, or if
            the resolution of the converter is given without a limit.
    """
    if level in NOISE_LEVELS:
        return NOISE_LEVELS[level]
    return load_amplifier(level).noise
