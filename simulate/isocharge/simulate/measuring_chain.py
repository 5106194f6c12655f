"""Simulation of how the film, the amplifier and the converter change charges over time: leak, hum, drift and clipping.

A charge amplifier is a leaky integrator with the time constant tau = R C. After a step of the charge, the output of the
amplifier decays by a factor of e within the time tau. The output v of the amplifier at reading n is

    v[n] = a v[n-1] + (g (q[n] - q[n-1]) + b dt) (1 + a) / 2,        a = exp(-dt / tau),

where q is the charge of the film, g is the gain, b is the bias current, and dt is the time between two readings. The
charge of the film is the sum of the touch charge and the pyroelectric charge. The simulation adds an offset, hum and
white noise to the output of the amplifier. Finally, the output is clipped and rounded to the codes of the converter.

The noise levels `bench` and `surgery` contain plausible values of the hum, the offset, the bias current and the
mismatch for environments with weak or strong electrical interference. The values of `bench` and `surgery` were not
measured. The noise levels `clean` and `reference` contain only noise that does not depend on earlier readings.

A TOML file can describe a further measuring chain. The function `load_amplifier` reads such a file.
"""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, get_type_hints

import numpy as np
import scipy  # loads each of its subpackages on first use
from msgspec import Meta, defstruct, structs

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError, error_context
from isocharge.common.files import StrPath
from isocharge.common.structs import Finite, NotNegative, Positive, Settings, read_toml
from isocharge.simulate.noise import NOISE_LEVELS, NoiseModel

PVDF_PYRO = -30.0 * 9.0
"""Pyroelectric charge per temperature change of a PVDF electrode of 9 mm^2, pC/K.

The pyroelectric coefficient is -30 uC/(m^2 K). The sign is negative if a press results in positive charges (d31 > 0),
because a warmer film is thicker, and a pressed film is thinner.
"""

FILM_TIME = 1.78e-3 * 1.2 * 0.025 / (2.0 * 1e-5)
"""Time constant with which a PVDF film of 25 um follows the temperature of the air at both faces, s.

The time constant is density * specific heat * thickness / (2 * heat transfer coefficient), with 1.78 g/cm^3, 1.2 J/(g
K) and 10 W/(m^2 K). The value of the heat transfer coefficient is typical of free convection and radiation.
"""

PositiveOrInfinite = Annotated[float, Meta(gt=0.0, description="a positive number or inf")]
"""Type of a positive parameter that may be infinite."""

Mismatch = Annotated[float, Meta(ge=0.0, le=0.2, description="a number from 0 to 0.2")]
"""Type of a small relative standard deviation, with which no randomly drawn factor is negative."""


@dataclass(frozen=True, kw_only=True)
class Amplifier:
    """Parameters of a simulated measuring chain with any number of channels.

    The types of the parameters state bounds, which are checked only when the parameters are read from a file.

    Attributes:
        noise: Noise of each reading, which does not depend on earlier readings.
        tau: Time constant of the leak, s; infinite for no leak.
        tau_mismatch: Standard deviation of the relative error of the time constant of a channel, dimensionless.
        gain_mismatch: Standard deviation of the relative error of the gain of a channel, dimensionless.
        hum: Amplitude of the mains hum, pC. The phase of the hum differs between channels.
        hum_frequency: Frequency of the mains hum, Hz.
        offset: Standard deviation of the constant offset of a channel, pC.
        bias: Magnitude of the bias current that every channel integrates, pC/s. The sign is drawn for each channel.
        pyro: Pyroelectric charge of each electrode per temperature change, pC/K; negative for PVDF with d31 > 0.
        pyro_mismatch: Standard deviation of the relative error of the pyroelectric charge of a channel, dimensionless.
        temperature_rms: Root mean square of the temperature drift of the film, K.
        temperature_time: Time constant of the temperature drift of the air, s.
        step: Temperature step of the air, K.
        step_at: Start of the temperature step, s.
        step_time: Duration of the rise of the temperature step, s.
        step_for: Time from the start of the temperature step until the temperature is back at its initial value, s.
        film_time: Time constant with which the film follows the temperature of the air, s.
        limit: Largest magnitude of a charge that can be read, pC; infinite for no limit.
        bits: Resolution of the converter between both limits; 0 for no converter.
    """

    noise: NoiseModel
    tau: PositiveOrInfinite = math.inf
    tau_mismatch: Mismatch = 0.0
    gain_mismatch: Mismatch = 0.0
    hum: NotNegative = 0.0
    hum_frequency: Positive = 50.0
    offset: NotNegative = 0.0
    bias: NotNegative = 0.0
    pyro: Finite = PVDF_PYRO
    pyro_mismatch: NotNegative = 0.0
    temperature_rms: NotNegative = 0.0
    temperature_time: Positive = 120.0
    step: Finite = 0.0
    step_at: Finite = 10.0
    step_time: Positive = 1.0
    step_for: PositiveOrInfinite = math.inf
    film_time: Positive = FILM_TIME
    limit: PositiveOrInfinite = math.inf
    bits: Annotated[int, Meta(ge=0, le=32)] = 0

    def __post_init__(self) -> None:
        if self.bits and not math.isfinite(self.limit):
            raise InputError(
                f"bits: a converter of {self.bits} bits needs the largest charge that it reads, got a limit of "
                f"{self.limit} pC; give limit_pC with bits, or bits = 0 for no converter"
            )

    def start(self, electrodes: int, rate: float, rng: np.random.Generator) -> "Measurement":
        """Draw the random properties of each channel, and start a measurement with a settled amplifier.

        Args:
            electrodes: Number of electrodes, each of which has one channel.
            rate: Readings per second, Hz.
            rng: Random number generator for the channel properties and the noise of all readings.

        Returns:
            The measurement, with the drawn properties of each channel.
        """
        return Measurement(self, electrodes, rate, rng)


class Measurement:
    """Running measurement that converts successive blocks of touch charges into readings.

    Attributes:
        amplifier: Parameters of the measuring chain.
        rate: Readings per second, Hz.
        rng: Random number generator for the noise.
        leak_time: Time constant of the leak of each channel, shape (electrodes,), s.
        gain: Gain of each channel, shape (electrodes,), dimensionless.
        bias: Bias current of each channel, shape (electrodes,), pC/s.
        offset: Offset of each channel, shape (electrodes,), pC.
        hum_phase: Phase of the hum of each channel, shape (electrodes,), rad.
        pyro_charge_per_K: Pyroelectric charge of each electrode per temperature change, shape (electrodes,), pC/K.
    """

    def __init__(self, amplifier: Amplifier, electrodes: int, rate: float, rng: np.random.Generator) -> None:
        """Draw the properties of the channels and the initial temperatures, and set all charges to stationary values.

        Each channel has its own time constant of the leak (s), gain, bias current (pC/s), offset (pC), phase of the hum
        (rad) and pyroelectric charge (pC/K).

        Args:
            amplifier: Parameters of the measuring chain.
            electrodes: Number of electrodes, each of which has one channel.
            rate: Readings per second, Hz.
            rng: Random number generator for the properties and the noise.
        """
        self.amplifier = amplifier
        self.rate = rate
        self.rng = rng
        self._reading_count = 0  # number of readings of all blocks so far

        # Do not change the order of the statements, because it determines which random numbers each property gets.
        self.leak_time = amplifier.tau * (1.0 + amplifier.tau_mismatch * rng.standard_normal(electrodes))
        self.gain = 1.0 + amplifier.gain_mismatch * rng.standard_normal(electrodes)
        self.bias = amplifier.bias * rng.choice([-1.0, 1.0], electrodes)
        self.offset = amplifier.offset * rng.standard_normal(electrodes)
        self.hum_phase = rng.uniform(0.0, math.tau, electrodes)

        # Without a mismatch of the pyroelectric charges, no random numbers are drawn for them.
        self.pyro_charge_per_K = np.full(electrodes, amplifier.pyro)
        if amplifier.pyro_mismatch:
            self.pyro_charge_per_K *= 1.0 + amplifier.pyro_mismatch * rng.standard_normal(electrodes)

        # Draw the temperatures of the film and of the air, relative to their mean (K). The film follows the air as a
        # low-pass filter. Let c be the correlation of both temperatures. The standard deviation of the film is then c
        # times that of the air. The film has the standard deviation `temperature_rms`, so the air has
        # `temperature_rms / c`.
        common_part, independent_part = amplifier.temperature_rms * rng.standard_normal(2)
        variance_ratio = self._variance_ratio  # variance of the film divided by the variance of the air
        correlation = math.sqrt(variance_ratio)
        self._air_temperature = common_part / correlation
        self._film_temperature = correlation * common_part + math.sqrt(1.0 - variance_ratio) * independent_part

        # There is no touch before the measurement, so the film has only its pyroelectric charge.
        self._film_charge = self.pyro_charge_per_K * self._film_temperature

        # The leak of the stationary output equals the bias current. Without a leak, there is no stationary output, and
        # the output starts at zero.
        self._output = np.zeros_like(self.gain)
        if math.isfinite(amplifier.tau):
            self._output = self.bias * self.leak_time

    def __call__(self, charge: Array) -> Array:
        """Simulate the readings of the next block of touch charges.

        The simulation applies the effects of the film, the amplifiers, the hum, the noise and the converter one after
        the other. The state of the measuring chain at the end of the block is stored for the next block.

        Args:
            charge: Touch charges, shape (n, electrodes), pC.

        Returns:
            Readings, shape (n, electrodes), pC.
        """
        if len(charge) == 0:
            return charge
        time = (self._reading_count + np.arange(len(charge))) / self.rate  # since the first reading, s
        self._reading_count += len(charge)

        # Charge of the film
        temperature = self._simulate_temperature(time)[:, np.newaxis]  # difference from the mean, shape (n, 1), K
        film_charge = charge + self.pyro_charge_per_K * temperature

        # Output of the amplifiers, and disturbances of the output
        output = self._integrate(film_charge) + self.offset
        hum_angle = math.tau * self.amplifier.hum_frequency * time[:, np.newaxis] + self.hum_phase
        output_with_hum = output + self.amplifier.hum * np.sin(hum_angle)
        noisy_output = self.amplifier.noise.add(output_with_hum, self.rng)
        return self._convert(noisy_output)

    @property
    def _variance_ratio(self) -> float:
        """Stationary variance of the film temperature divided by the variance of the air temperature, dimensionless."""
        return self.amplifier.temperature_time / (self.amplifier.temperature_time + self.amplifier.film_time)

    def _simulate_temperature(self, time: Array) -> Array:
        """Simulate the temperature of the film relative to its mean.

        The temperature of the air drifts as a first-order autoregressive process, and changes by the temperature step.
        The temperature of the film follows the temperature of the air as a first-order low-pass filter with the time
        constant `film_time`. The step starts at the time `step_at`, and the air has its initial temperature again after
        the time `step_for`.

        Args:
            time: Times of the readings, shape (n,), s.

        Returns:
            Temperature, shape (n,), K.
        """
        amplifier = self.amplifier
        air_decay = math.exp(-1.0 / (self.rate * amplifier.temperature_time))
        film_decay = math.exp(-1.0 / (self.rate * amplifier.film_time))

        # The drift of the air is drift[n] = air_decay * drift[n - 1] + innovations[n], with random innovations. Their
        # standard deviation is chosen such that the film has the standard deviation `temperature_rms`. The property
        # `_variance_ratio` is the variance of the film divided by the variance of the air.
        innovation_std = math.sqrt((1.0 - air_decay * air_decay) / self._variance_ratio) * amplifier.temperature_rms
        innovations = innovation_std * self.rng.standard_normal(time.size)
        drift = _decaying_sum(air_decay, innovations, self._air_temperature)

        # The temperature step of the air has the shape of a trapezium: it rises, remains constant, and falls again. The
        # rise ends `step_time` after the start of the step, and the fall begins `step_time` before its end.
        time_since_start = time - amplifier.step_at
        time_until_end = amplifier.step_for - time_since_start
        relative_step = np.clip(np.minimum(time_since_start, time_until_end) / amplifier.step_time, 0.0, 1.0)
        air_temperature = drift + amplifier.step * relative_step

        # The film is a low-pass filter: film[n] = film_decay * film[n - 1] + (1 - film_decay) * air[n]
        film_temperature = _decaying_sum(film_decay, (1.0 - film_decay) * air_temperature, self._film_temperature)

        # Store the state for the next call. The step of the air is not stored, because it follows from the time.
        self._air_temperature = float(drift[-1])
        self._film_temperature = float(film_temperature[-1])
        return film_temperature

    def _integrate(self, film_charge: Array) -> Array:
        """Compute the output of the charge amplifiers, which are leaky integrators.

        The last charges and the last output are stored for the next call.

        Args:
            film_charge: Charges of the film, shape (n, n_electrode), pC.

        Returns:
            Output charges, same shape, pC.
        """
        changes = np.diff(film_charge, axis=0, prepend=self._film_charge[np.newaxis])
        self._film_charge = film_charge[-1]
        bias_charge = self.bias / self.rate  # charge of the bias current between two readings, shape (n_electrode,)
        inputs = self.gain * changes + bias_charge

        # Each channel has its own time constant. The filter of a channel is output[n] = decay * output[n - 1] +
        # inputs[n]. A charge that arrives just after a reading decays by the factor `decay` until the next reading, and
        # a charge that arrives just before the next reading does not decay. The mean factor is about (1 + decay) / 2.
        decays = np.exp(-1.0 / (self.rate * self.leak_time))
        inputs *= 0.5 * (1.0 + decays)
        channels = zip(decays.tolist(), inputs.T, self._output.tolist(), strict=True)  # the last is the previous output
        outputs = [_decaying_sum(decay, channel_inputs, previous) for decay, channel_inputs, previous in channels]
        output = np.stack(outputs, axis=1)
        self._output = output[-1]
        return output

    def _convert(self, output: Array) -> Array:
        """Clip the output at the limits of the amplifier, and round the output to the codes of the converter.

        Args:
            output: Output charges, shape (n, n_electrode), pC.

        Returns:
            Readings, same shape, pC.
        """
        limit = self.amplifier.limit
        bits = self.amplifier.bits
        if not bits:
            return np.clip(output, -limit, limit)

        # The converter has 2^bits codes for the range from -limit to limit.
        half_count = 2 ** (bits - 1)
        charge_per_code = limit / half_count
        codes = np.clip(np.round(output / charge_per_code), -half_count, half_count - 1)
        return np.asarray(codes * charge_per_code)


def _decaying_sum(decay: float, inputs: Array, previous: float) -> Array:
    """Compute the outputs output[n] = decay * output[n - 1] + inputs[n] of a first-order low-pass filter.

    Args:
        decay: Factor by which the output decays between two readings.
        inputs: Inputs, shape (n,).
        previous: Output before the first input.

    Returns:
        Outputs, shape (n,).
    """
    outputs, _ = scipy.signal.lfilter([1.0], [1.0, -decay], inputs, zi=[decay * previous])
    return np.asarray(outputs)


BENCH_AMPLIFIER = Amplifier(
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
"""Amplifier of the level `bench`, which is plausible for an environment with weak electrical interference."""

AMPLIFIER_LEVELS = {
    **{level: Amplifier(noise=NOISE_LEVELS[level]) for level in ("clean", "reference", "measured")},
    "bench": BENCH_AMPLIFIER,
    "surgery": replace(BENCH_AMPLIFIER, noise=NOISE_LEVELS["surgery"], hum=5.0, step=0.5),
}
"""Amplifier of each noise level."""

AMPLIFIER_FILE_KEYS = {
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
"""Keys of the TOML file that contain a unit and therefore differ from the attribute names of `Amplifier`.

The dictionary maps the name of each of these attributes to its key.
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
    rename=AMPLIFIER_FILE_KEYS,
)
"""Content of the TOML file, which consists of the parameters of the noise and the attributes of `Amplifier`.

Each value must be within the bounds that the type of its attribute states. If a key is absent, the value of the level
`like` is used.
"""


def load_amplifier(level: StrPath) -> Amplifier:
    """Return the built-in amplifier of a noise level, or an amplifier that is described in a TOML file.

    Example of a file:

        like = "bench"       # optional: level with the values of absent keys
        white_pC = 0.5
        tau_s = 1.0          # inf for no leak

    Args:
        level: Name of a noise level, or path of a TOML file that describes an amplifier.

    Returns:
        The amplifier. The noise of an amplifier from a file is named after the file.

    Raises:
        InputError: If the level or the file does not exist, if a key is unknown or its value is out of range, or if
            the resolution of the converter is given without a limit.
    """
    if level in AMPLIFIER_LEVELS:
        return AMPLIFIER_LEVELS[level]
    if Path(level).suffix != ".toml":
        raise InputError(f"noise level: expected one of {', '.join(AMPLIFIER_LEVELS)}, or a TOML file, got {level!r}")
    file = read_toml(level, "the description of noise", InputError, AmplifierFile)
    changes = {name: value for name, value in structs.asdict(file).items() if value is not None}

    # Remove the level and the parameters of the noise, because the remaining keys must be attributes of the amplifier.
    # The key `like` is always present, because it has the default "clean".
    similar_amplifier = AMPLIFIER_LEVELS[changes.pop("like")]
    white = changes.pop("white_pC", similar_amplifier.noise.white)
    gain = changes.pop("proportional", similar_amplifier.noise.gain)
    noise = NoiseModel(Path(level).stem, white, gain)
    with error_context(InputError, f"{level}: "):
        return replace(similar_amplifier, noise=noise, **changes)


def noise_model(level: StrPath) -> NoiseModel:
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
    return load_amplifier(level).noise
