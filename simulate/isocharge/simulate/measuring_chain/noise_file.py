"""Noise models and amplifiers for the levels clean, reference, bench and surgery, and their reader from a TOML file."""

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
"""Noise models of the levels. For `bench` and `surgery`, they are the memoryless part of the amplifiers."""

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
    "bench": BENCH,
    "surgery": replace(BENCH, noise=NOISE_LEVELS["surgery"], hum=5.0, step=0.5),
}
"""Amplifiers of the levels."""

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
"""Keys of the TOML file by the attributes of `Amplifier`.

These keys differ from the attributes, because they contain the unit.
"""

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
    rename=KEY_NAMES,
)
"""Content of the TOML file: the noise, and the attributes of `Amplifier` with their bounds.

An absent key has the value of the level `like`.
"""


def load_amplifier(level: str) -> Amplifier:
    """Return the built-in amplifier of a noise level, or an amplifier that is described in a TOML file.

    Example of a file:

        like = "bench"       # optional: level with the values of absent keys
        white_pC = 0.5
        tau_s = 1.0          # inf for no leak

    Args:
        level: Name of a level, or path of a TOML file.

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

    # The keys of the noise are removed from the changes, so that the remaining keys are attributes of the amplifier.
    similar_amplifier = AMPLIFIER_LEVELS[changes.pop("like")]
    white = changes.pop("white_pC", similar_amplifier.noise.white)
    gain = changes.pop("proportional", similar_amplifier.noise.gain)
    name = Path(level).stem
    with error_prefix(f"{level}: ", InputError):
        return replace(similar_amplifier, noise=NoiseModel(name, white, gain), **changes)


def noise_model(level: str) -> NoiseModel:
    """Return the built-in noise model of a level, or a noise model that is described in a TOML file.

    The file may describe a complete measuring chain (`load_amplifier`). Only the memoryless noise is returned.

    Example of a file:

        like = "reference"      # optional: level with the values of absent keys, by default "clean"
        white_pC = 0.5
        proportional = 0.001    # standard deviation divided by the charge

    Args:
        level: Name of a level, or path of a TOML file.

    Raises:
        InputError: If the level or the file does not exist, or if a key is unknown or its value out of range.
    """
    if level in NOISE_LEVELS:
        return NOISE_LEVELS[level]
    return load_amplifier(level).noise
