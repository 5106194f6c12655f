"""Simulation of the measuring chain: how the film, the amplifier and the converter change touch charges over time.

A charge amplifier is a leaky integrator with the time constant tau = R C, so that a step of the charge decays by a
factor of e within tau. The output of reading n is

    v[n] = exp(-dt / tau) v[n-1] + g (q[n] - q[n-1]) + b dt,

where q is the charge of the film (touch charge and pyroelectric charge), g the gain and b the bias current. Offset,
hum, white noise, clipping and the rounding of the converter are then applied to the output. A film with creep responds
to a unit step of the touch charge with

    h(t) = 1 - creep log10(t / 1 s) + thermoelastic exp(-t / film_time).

The logarithm is valid for times from some milliseconds to days. A Prony series with two terms per decade approximates
the logarithm, and Boltzmann's superposition principle gives the response to any touch charge. The exponential describes
the cooling of the film when it is stretched, and its return to the initial temperature.

The built-in levels contain plausible values of hum, offset, bias and mismatch for electric environments with little or
with strong interference. They were not measured. The levels `clean` and `reference` contain only the memoryless noise
of `measuring_chain.noise`.
"""

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import scipy  # loads each of its subpackages on first use
from msgspec import Meta

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError
from isocharge.common.structs import Finite, NotNegative, Positive
from isocharge.simulate.measuring_chain.noise import NoiseModel

PVDF_PYRO = -30.0 * 9.0
"""Pyroelectric charge of a PVDF electrode of 9 mm^2 per temperature change, pC/K, for -30 uC/(m^2 K).

The sign is negative if a press results in positive charges (d31 > 0), because a warmer film is thicker, and a pressed
film is thinner."""

FILM_TIME = 1.78e-3 * 1.2 * 0.025 / (2.0 * 1e-5)
"""Time constant with which a PVDF film of 25 um follows the temperature of the air at both faces, s.

The time constant is density * specific heat * thickness / (2 * heat transfer coefficient), with 1.78 g/cm^3,
1.2 J/(g K) and 10 W/(m^2 K). This heat transfer coefficient is typical of free convection and radiation."""


CREEP_TIMES = 10.0 ** np.arange(-3.0, 6.1, 0.5)
"""Time constants of the Prony series of creep, s."""


PositiveOrInfinite = Annotated[float, Meta(gt=0.0, description="a positive number or inf")]
"""Type of a parameter that may be infinite."""


@dataclass(frozen=True, kw_only=True)
class Amplifier:
    """Parameters of a measuring chain with any number of channels.

    The bounds of the parameters apply to files (`measuring_chain.noise_file`).

    Attributes:
        noise: Memoryless noise of each reading.
        tau: Time constant of the leak, s; infinite for no leak.
        tau_mismatch: Standard deviation of the relative error of the time constant of a channel, dimensionless.
        gain_mismatch: Standard deviation of the relative error of the gain of a channel, dimensionless.
        hum: Amplitude of the mains hum, pC. The phase of the hum differs between channels.
        hum_frequency: Frequency of the mains hum, Hz.
        offset: Standard deviation of the constant offset of a channel, pC.
        bias: Magnitude of the bias current that every channel integrates, pC/s. Its sign differs between channels.
        pyro: Pyroelectric charge of each electrode per temperature change, pC/K; negative for PVDF with d31 > 0.
        pyro_mismatch: Standard deviation of the relative error of the pyroelectric charge of a channel, dimensionless.
        creep: Share of a touch charge that is lost in each decade of time, dimensionless.
        thermoelastic: Initial increase of a touch charge by the cooling of the film, relative to the touch charge,
            dimensionless.
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
    tau_mismatch: NotNegative = 0.0
    gain_mismatch: NotNegative = 0.0
    hum: NotNegative = 0.0
    hum_frequency: Positive = 50.0
    offset: NotNegative = 0.0
    bias: NotNegative = 0.0
    pyro: Finite = PVDF_PYRO
    pyro_mismatch: NotNegative = 0.0
    creep: Annotated[float, Meta(ge=0.0, lt=0.2)] = 0.0
    thermoelastic: NotNegative = 0.0
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
        """Start a measurement with random mismatches after the amplifier has settled.

        Args:
            electrodes: Number of channels.
            rate: Readings per second, Hz.
            rng: Generator of the mismatches and of the noise of all readings.

        Returns:
            The measurement, with the properties of each channel.
        """
        # The order of these calls determines the random numbers of each property.
        tau = self.tau * (1.0 + self.tau_mismatch * rng.standard_normal(electrodes))
        gain = 1.0 + self.gain_mismatch * rng.standard_normal(electrodes)
        bias = self.bias * rng.choice([-1.0, 1.0], electrodes)
        offset = self.offset * rng.standard_normal(electrodes)
        phase = rng.uniform(0.0, 2.0 * np.pi, electrodes)
        pyro = np.full(electrodes, self.pyro)
        if self.pyro_mismatch:  # without this mismatch, no random numbers are drawn
            pyro = self.pyro * (1.0 + self.pyro_mismatch * rng.standard_normal(electrodes))
        return Measurement(self, rate, rng, tau, gain, bias, offset, phase, pyro)


@dataclass
class Measurement:
    """Running measurement, which is called with successive blocks of touch charges and returns their readings.

    Attributes:
        amplifier: Parameters of the measuring chain.
        rate: Readings per second, Hz.
        rng: Generator of the noise.
        tau: Time constant of the leak of each channel, shape (electrodes,), s.
        gain: Gain of each channel, shape (electrodes,), dimensionless.
        bias: Bias current of each channel, shape (electrodes,), pC/s.
        offset: Offset of each channel, shape (electrodes,), pC.
        phase: Phase of the hum of each channel, shape (electrodes,), rad.
        pyro: Pyroelectric charge of each electrode per temperature change, shape (electrodes,), pC/K.
    """

    amplifier: Amplifier
    rate: float
    rng: np.random.Generator
    tau: Array
    gain: Array
    bias: Array
    offset: Array
    phase: Array
    pyro: Array
    _readings: int = 0
    _film_charge: Array = field(init=False)
    _output: Array = field(init=False)
    _air_temperature: float = field(init=False)
    _film_temperature: float = field(init=False)
    _relaxation: Array = field(init=False)
    _touch_charge: Array = field(init=False)

    def __post_init__(self) -> None:
        """Draw the initial temperatures, and set all charges to their stationary values at these temperatures."""
        amplifier = self.amplifier

        # Draw correlated temperatures of the air and the film. The film has the standard deviation `temperature_rms`.
        # The low-pass filter of the film reduces the standard deviation of the air by the factor `correlation`, which
        # is also the correlation of the two stationary temperatures.
        common, independent = amplifier.temperature_rms * self.rng.standard_normal(2)
        variance_ratio = self._variance_ratio
        correlation = math.sqrt(variance_ratio)
        self._air_temperature = common / correlation
        self._film_temperature = correlation * common + math.sqrt(1.0 - variance_ratio) * independent

        # There is no touch before the measurement, so the film has only its pyroelectric charge.
        self._film_charge = self.pyro * self._film_temperature
        self._touch_charge = np.zeros_like(self.gain)
        self._relaxation = np.zeros((CREEP_TIMES.size + 1, 1, self.gain.size))
        self._output = np.zeros_like(self.gain)
        has_leak = math.isfinite(amplifier.tau)
        if has_leak:
            # In the stationary state, output = decay * output + bias / rate for each channel.
            decay = np.exp(-1.0 / (self.rate * self.tau))  # of the output between two readings
            self._output = self.bias / (1.0 - decay) / self.rate

    def __call__(self, charge: Array, charge_per_K: Array | None = None) -> Array:
        """Simulate the readings of the next block of touch charges.

        The charges pass through the film (temperature, creep, pyroelectric charge), the amplifiers, the hum, the noise
        and the converter, in this order. The state at the end of the block is stored for the next block.

        Args:
            charge: Touch charges, shape (n, electrodes), pC.
            charge_per_K: Change of the touch charges per kelvin of the film, because the pretension of a warm film is
                smaller, shape (n, electrodes), pC/K. None if the temperature does not change the touch charges.

        Returns:
            Readings, shape (n, electrodes), pC.
        """
        time = (self._readings + np.arange(len(charge))) / self.rate
        self._readings += len(charge)

        # Charge of the film, output of the amplifiers, and disturbances of the output
        temperature = self._temperature(time)[:, np.newaxis]  # relative to the mean, shape (n, 1), K
        if charge_per_K is not None:
            charge = charge + charge_per_K * temperature
        film_charge = self._relaxed(charge) + self.pyro * temperature
        output = self._integrate(film_charge) + self.offset
        hum_angle = 2.0 * np.pi * self.amplifier.hum_frequency * time[:, np.newaxis] + self.phase
        output_with_hum = output + self.amplifier.hum * np.sin(hum_angle)
        noisy_output = self.amplifier.noise.add(output_with_hum, self.rng)
        return self._convert(noisy_output)

    def _relaxed(self, charge: Array) -> Array:
        """Compute the effect of creep and of the thermoelastic effect on touch charges.

        Both effects are sums of decaying exponentials. Each exponential is computed by a recursive filter of the
        changes of the charge. The state of the filter is stored for the next call.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.

        Returns:
            Charges with creep and thermoelastic effect, same shape, pC.
        """
        amplifier = self.amplifier
        if not amplifier.creep and not amplifier.thermoelastic:
            return charge
        changes = np.diff(charge, axis=0, prepend=self._touch_charge[np.newaxis])
        self._touch_charge = charge[-1]

        # Time constants and amplitudes of the exponentials: those of the creep, then the thermoelastic effect
        time_constants = np.append(CREEP_TIMES, amplifier.film_time)
        creep_amplitudes = np.full(CREEP_TIMES.size, 0.5 * amplifier.creep)  # two terms per decade
        amplitudes = np.append(creep_amplitudes, amplifier.thermoelastic)
        # With this factor, the creep changes nothing one second after a touch.
        factor = 1.0 - 0.5 * amplifier.creep * np.exp(-1.0 / CREEP_TIMES).sum()
        relaxed: Array = factor * charge
        for index, (time_constant, amplitude) in enumerate(zip(time_constants, amplitudes, strict=True)):
            decay = math.exp(-1.0 / (self.rate * time_constant))
            # exponential[n] = decay * exponential[n - 1] + amplitude * changes[n]
            exponential, self._relaxation[index] = scipy.signal.lfilter(
                [amplitude], [1.0, -decay], changes, axis=0, zi=self._relaxation[index]
            )
            relaxed = relaxed + exponential
        return relaxed

    @property
    def _variance_ratio(self) -> float:
        """Stationary variance of the temperature of the film divided by that of the air, dimensionless."""
        return self.amplifier.temperature_time / (self.amplifier.temperature_time + self.amplifier.film_time)

    def _temperature(self, time: Array) -> Array:
        """Simulate the temperature of the film relative to its mean.

        The drift of the air is a first-order autoregressive process, and the film is a first-order low-pass filter.

        Args:
            time: Times of the readings, shape (n,), s.

        Returns:
            Temperature, shape (n,), K.
        """
        amplifier = self.amplifier
        air_decay = math.exp(-1.0 / (self.rate * amplifier.temperature_time))
        film_decay = math.exp(-1.0 / (self.rate * amplifier.film_time))

        # Drift of the air: drift[n] = air_decay * drift[n - 1] + innovations[n]. The innovations are scaled such that
        # the temperature of the film has the standard deviation `temperature_rms`.
        innovation_std = math.sqrt((1.0 - air_decay * air_decay) / self._variance_ratio) * amplifier.temperature_rms
        innovations = innovation_std * self.rng.standard_normal(time.size)
        air_start = [air_decay * self._air_temperature]
        drift, _ = scipy.signal.lfilter([1.0], [1.0, -air_decay], innovations, zi=air_start)

        # Trapezoidal change of the temperature of the air: ramp up, constant value, ramp down
        time_since_step = time - amplifier.step_at
        time_until_end = amplifier.step_for - time_since_step
        relative_step = np.clip(np.minimum(time_since_step, time_until_end) / amplifier.step_time, 0.0, 1.0)
        air = drift + amplifier.step * relative_step

        # Low-pass filter of the film: film[n] = film_decay * film[n - 1] + (1 - film_decay) * air[n]
        film_start = [film_decay * self._film_temperature]
        film: Array
        film, _ = scipy.signal.lfilter([1.0 - film_decay], [1.0, -film_decay], air, zi=film_start)
        self._air_temperature = float(drift[-1])
        self._film_temperature = float(film[-1])
        return film

    def _integrate(self, film_charge: Array) -> Array:
        """Compute the output of the charge amplifiers, which are leaky integrators.

        Args:
            film_charge: Charges of the film, shape (n, n_electrode), pC.

        Returns:
            Output charges, same shape, pC.
        """
        changes = np.diff(film_charge, axis=0, prepend=self._film_charge[np.newaxis])
        self._film_charge = film_charge[-1]
        bias_charge = self.bias / self.rate  # charge of the bias current between two readings
        inputs = self.gain * changes + bias_charge

        # Each channel has its own time constant: output[n] = decay * output[n - 1] + inputs[n]
        decays = np.exp(-1.0 / (self.rate * self.tau))
        output = np.empty_like(inputs)
        for channel, decay in enumerate(decays):
            start = [decay * self._output[channel]]
            channel_output, _ = scipy.signal.lfilter([1.0], [1.0, -decay], inputs[:, channel], zi=start)
            output[:, channel] = channel_output
        self._output = output[-1]
        return output

    def _convert(self, output: Array) -> Array:
        """Clip the output at the limit of the amplifier, and round it to the steps of the analogue-digital converter.

        Args:
            output: Output charges, shape (n, n_electrode), pC.

        Returns:
            Readings, same shape, pC.
        """
        limit = self.amplifier.limit
        bits = self.amplifier.bits
        clipped = np.clip(output, -limit, limit)
        if not bits:
            return clipped

        # The converter has 2^bits codes for the range from -limit to limit.
        charge_per_code = 2.0 * limit / 2**bits
        lowest_code = -(2 ** (bits - 1))
        highest_code = 2 ** (bits - 1) - 1
        codes = np.clip(np.round(clipped / charge_per_code), lowest_code, highest_code)
        return np.asarray(codes * charge_per_code)
