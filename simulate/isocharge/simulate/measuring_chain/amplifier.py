"""Simulation of the measuring chain: effect of film, amplifier and converter on touch charges over time.

A charge amplifier is a leaky integrator with the time constant tau = R C, so that a step of the charge decays by a
factor of e within tau. The output of reading n is

    v[n] = exp(-dt / tau) v[n-1] + g (q[n] - q[n-1]) + b dt,

where q is the charge of the film (touch charge and pyroelectric charge), g the gain and b the bias current. Offset,
hum, white noise, clipping and the rounding of the converter follow. A film with creep responds to a unit step of the
touch charge with

    h(t) = 1 - creep log10(t / 1 s) + thermoelastic exp(-t / film_time).

The logarithm is valid from some milliseconds to days. It is approximated by a Prony series with two terms per decade,
according to Boltzmann's superposition principle. The exponential describes the cooling of the stretched film, which
lasts until the film has its initial temperature again.

The values of hum, offset, bias and mismatch in the built-in levels are engineering choices for a tidy and for a noisy
electric environment; they are not measurements. The memoryless noise is defined in `measuring_chain.noise`; the levels
`clean` and `reference` contain only this noise.
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

It is negative if a press gives positive charges (d31 > 0), because warming makes the film thicker and a press makes it
thinner."""

FILM_TIME = 1.78e-3 * 1.2 * 0.025 / (2.0 * 1e-5)
"""Time constant with which a PVDF film of 25 um follows the temperature of the air at both faces, s.

It is density times specific heat times thickness divided by twice the heat transfer coefficient, for 1.78 g/cm^3,
1.2 J/(g K) and 10 W/(m^2 K), which is typical of free convection and radiation."""


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
        thermoelastic: Share by which a touch charge is initially increased, dimensionless.
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
        tau = self.tau * (1.0 + self.tau_mismatch * rng.standard_normal(electrodes))
        gain = 1.0 + self.gain_mismatch * rng.standard_normal(electrodes)
        bias = self.bias * rng.choice([-1.0, 1.0], electrodes)
        offset = self.offset * rng.standard_normal(electrodes)
        phase = rng.uniform(0.0, 2.0 * np.pi, electrodes)
        pyro = np.full(electrodes, self.pyro)
        if self.pyro_mismatch:
            pyro = self.pyro * (1.0 + self.pyro_mismatch * rng.standard_normal(electrodes))
        return Measurement(self, rate, rng, tau, gain, bias, offset, phase, pyro)


@dataclass
class Measurement:
    """Running measurement, which is called with successive blocks of touch charges.

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
        """Draw the temperatures at the beginning, and set the charges to their stationary values."""
        first, second = self.amplifier.temperature_rms * self.rng.standard_normal(2)
        variance_ratio = self._variance_ratio
        correlation = math.sqrt(variance_ratio)  # between the stationary temperatures of the film and the air
        self._air_temperature = first / correlation
        self._film_temperature = correlation * first + math.sqrt(1.0 - variance_ratio) * second
        self._film_charge = self.pyro * self._film_temperature
        self._touch_charge = np.zeros_like(self.gain)
        self._relaxation = np.zeros((CREEP_TIMES.size + 1, 1, self.gain.size))
        self._output = np.zeros_like(self.gain)
        if math.isfinite(self.amplifier.tau):
            self._output = self.bias / (1.0 - np.exp(-1.0 / (self.rate * self.tau))) / self.rate

    def __call__(self, charge: Array, charge_per_K: Array | None = None) -> Array:
        """Simulate the readings of the next block of touch charges.

        Args:
            charge: Touch charges, shape (n, electrodes), pC.
            charge_per_K: Change of the touch charges per kelvin of the film, because the pretension of a warm film is
                smaller, shape (n, electrodes), pC/K. None if the temperature does not change the touch charges.

        Returns:
            Readings, shape (n, electrodes), pC.
        """
        time = (self._readings + np.arange(len(charge))) / self.rate
        self._readings += len(charge)
        temperature = self._temperature(time)[:, np.newaxis]
        if charge_per_K is not None:
            charge = charge + charge_per_K * temperature
        film_charge = self._relaxed(charge) + self.pyro * temperature
        output = self._integrate(film_charge) + self.offset
        hum_angle = 2.0 * np.pi * self.amplifier.hum_frequency * time[:, np.newaxis] + self.phase
        noisy = self.amplifier.noise.add(output + self.amplifier.hum * np.sin(hum_angle), self.rng)
        return self._convert(noisy)

    def _relaxed(self, charge: Array) -> Array:
        """Apply creep and the thermoelastic effect to touch charges.

        Both effects are sums of exponentials. Each exponential is a recursive filter of the changes of the charge, and
        the state of the filter is kept for the next call.

        Args:
            charge: Touch charges, shape (n, n_electrode), pC.

        Returns:
            Charges with creep and thermoelastic effect, same shape, pC.
        """
        chain = self.amplifier
        if not chain.creep and not chain.thermoelastic:
            return charge
        changes = np.diff(charge, axis=0, prepend=self._touch_charge[np.newaxis])
        self._touch_charge = charge[-1]

        time_constants = np.append(CREEP_TIMES, chain.film_time)
        creep_shares = np.full(CREEP_TIMES.size, 0.5 * chain.creep)
        shares = np.append(creep_shares, chain.thermoelastic)
        # The factor makes the charge equal to the touch charge one second after the touch.
        relaxed: Array = (1.0 - 0.5 * chain.creep * np.exp(-1.0 / CREEP_TIMES).sum()) * charge
        for index, (time_constant, share) in enumerate(zip(time_constants, shares, strict=True)):
            decay = math.exp(-1.0 / (self.rate * time_constant))
            exponential, self._relaxation[index] = scipy.signal.lfilter(
                [share], [1.0, -decay], changes, axis=0, zi=self._relaxation[index]
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
        chain = self.amplifier
        air_decay = math.exp(-1.0 / (self.rate * chain.temperature_time))
        film_decay = math.exp(-1.0 / (self.rate * chain.film_time))

        # Drift of the air, with the innovations that give the film the rms value `temperature_rms`
        innovation_std = math.sqrt((1.0 - air_decay * air_decay) / self._variance_ratio) * chain.temperature_rms
        innovations = innovation_std * self.rng.standard_normal(time.size)
        air_start = [air_decay * self._air_temperature]
        drift = scipy.signal.lfilter([1.0], [1.0, -air_decay], innovations, zi=air_start)[0]

        # Trapezoidal change of the temperature of the air: ramp up, constant value, ramp down
        time_since_step = time - chain.step_at
        time_until_end = chain.step_for - time_since_step
        step_share = np.clip(np.minimum(time_since_step, time_until_end) / chain.step_time, 0.0, 1.0)
        air = drift + chain.step * step_share

        film_start = [film_decay * self._film_temperature]
        film: Array = scipy.signal.lfilter([1.0 - film_decay], [1.0, -film_decay], air, zi=film_start)[0]
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
        decays = np.exp(-1.0 / (self.rate * self.tau))
        output = np.empty_like(inputs)
        for channel, decay in enumerate(decays):
            start = [decay * self._output[channel]]
            output[:, channel] = scipy.signal.lfilter([1.0], [1.0, -decay], inputs[:, channel], zi=start)[0]
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
        charge_per_code = 2.0 * limit / (1 << bits)
        lowest_code = -(1 << (bits - 1))
        highest_code = (1 << (bits - 1)) - 1
        codes = np.clip(np.round(clipped / charge_per_code), lowest_code, highest_code)
        return np.asarray(codes * charge_per_code)
