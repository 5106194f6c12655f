"""The measuring chain forwards: what film, amplifier and converter make of touch charges, in time.

A charge amplifier is a leaky integrator, tau = R C: a step of charge decays by 1/e within tau. So reading n is

    v[n] = exp(-dt / tau) v[n-1] + g (q[n] - q[n-1]) + b dt,

with q the film's charge (touch, and pyroelectricity), g the gain and b the bias current; then come offset, hum, white
noise, clipping and the converter's steps. A film that creeps answers a step of touch charge with that step times

    h(t) = 1 - creep log10(t / 1 s) + thermoelastic exp(-t / film_time):

the logarithm from some milliseconds to days (Boltzmann's superposition, a Prony series with two terms in each decade),
and what is stretched cools, until the film has its temperature again. The sizes in the levels that the film does not
give - hum, offset, bias, mismatch - are engineering choices for a tidy and a bad electric neighbourhood, not
measurements. The memoryless part is `measuring_chain.noise`, and the levels `clean` and `reference` are nothing else.
"""

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import scipy  # loads a part when it is used
from msgspec import Meta

from isocharge.common.arrays import Array
from isocharge.common.errors import InputError
from isocharge.common.structs import Finite, NotNegative, Positive
from isocharge.simulate.measuring_chain.noise import NoiseModel

PVDF_PYRO = -30.0 * 9.0
"""Pyroelectric charge per temperature of a PVDF electrode of 9 mm^2, pC/K: -30 uC/(m^2 K).

Negative where a press gives positive charges (d31 > 0): warming thickens the film, a press thins it."""

FILM_TIME = 1.78e-3 * 1.2 * 0.025 / (2.0 * 1e-5)
"""Time in which a PVDF film of 25 um follows the temperature of the air at both faces, s: 2.7.

Density times specific heat times thickness over twice the heat transfer: 1.78 g/cm^3, 1.2 J/(g K) and 10 W/(m^2 K),
free convection and radiation."""


CREEP_TIMES = 10.0 ** np.arange(-3.0, 6.1, 0.5)
"""Time constants of creep, s; the ripple of their sum about the logarithm is below 1e-5 of a decade."""


PositiveOrInfinite = Annotated[float, Meta(gt=0.0, description="a positive number or inf")]


@dataclass(frozen=True, kw_only=True)
class Amplifier:
    """A measuring chain of any number of channels; the bounds are those of a file (`measuring_chain.noise_file`).

    Attributes:
        noise: Memoryless noise of each reading.
        tau: Time constant of the leak, s; infinite for none.
        tau_mismatch, gain_mismatch: Standard deviation of a channel's relative error.
        hum: Amplitude of the mains hum, pC; its phase differs between channels.
        hum_frequency: Hz.
        offset: Standard deviation of a channel's constant output, pC.
        bias: Current that every channel integrates, pC/s; its sign differs.
        pyro: Charge of warming, pC/K, on every electrode; negative for PVDF with d31 > 0.
        pyro_mismatch: Standard deviation of that charge on a channel, relative.
        creep: Share of a charge that is lost in each decade of time.
        thermoelastic: Share that a touch has more at first.
        temperature_rms: Root mean square of the film's temperature drift, K.
        temperature_time: Time constant of the air's drift, s: a calm room wanders over minutes.
        step: Temperature step of the air, K.
        step_at, step_time: Start of the temperature step, and time that it takes, s.
        step_for: Time from its start after which the temperature goes back, s.
        film_time: Time constant with which the film follows the air, s.
        limit: Largest charge that can be read, pC; infinite for any.
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
        """Switch the amplifier on: draw its mismatches and let it settle.

        Args:
            electrodes: Number of channels.
            rate: Readings per second, Hz.
            rng: Random numbers of the mismatches and of all readings.
        """
        tau = self.tau * (1.0 + self.tau_mismatch * rng.standard_normal(electrodes))
        gain = 1.0 + self.gain_mismatch * rng.standard_normal(electrodes)
        bias = self.bias * rng.choice([-1.0, 1.0], electrodes)
        offset = self.offset * rng.standard_normal(electrodes)
        phase = rng.uniform(0.0, 2.0 * np.pi, electrodes)
        spread = self.pyro_mismatch * rng.standard_normal(electrodes) if self.pyro_mismatch else np.zeros(electrodes)
        return Measurement(self, rate, rng, tau, gain, bias, offset, phase, self.pyro * (1.0 + spread))


@dataclass
class Measurement:
    """A running amplifier: call it with the charges block by block.

    Attributes:
        amplifier, rate, rng: As given to `Amplifier.start`.
        tau, gain, bias, offset, phase, pyro: Values drawn for each channel, shape (electrodes,).
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
    _charge: Array = field(init=False)
    _output: Array = field(init=False)
    _warmth: tuple[float, float] = field(init=False)
    _memory: Array = field(init=False)
    _touch: Array = field(init=False)

    def __post_init__(self) -> None:
        first, second = self.amplifier.temperature_rms * self.rng.standard_normal(2)
        share = self._share_of_air
        self._warmth = first / math.sqrt(share), math.sqrt(share) * first + math.sqrt(1.0 - share) * second
        self._charge = self.pyro * self._warmth[1]
        self._touch = np.zeros_like(self.gain)
        self._memory = np.zeros((CREEP_TIMES.size + 1, 1, self.gain.size))
        self._output = np.zeros_like(self.gain)
        if math.isfinite(self.amplifier.tau):
            self._output = self.bias / (1.0 - np.exp(-1.0 / (self.rate * self.tau))) / self.rate

    def __call__(self, charge: Array) -> Array:
        """Readings of the next touch charges, both of shape (n, electrodes), pC."""
        time = (self._readings + np.arange(len(charge))) / self.rate
        self._readings += len(charge)
        film = self._remembered(charge) + self.pyro * self._temperature(time)[:, np.newaxis]
        output = self._integrate(film) + self.offset
        turn = 2.0 * np.pi * self.amplifier.hum_frequency * time[:, np.newaxis] + self.phase
        noisy = self.amplifier.noise.add(output + self.amplifier.hum * np.sin(turn), self.rng)
        return self._convert(noisy)

    def _remembered(self, charge: Array) -> Array:
        """What creep and the thermoelastic step make of touch charges, shape (n, electrodes), pC."""
        part = self.amplifier
        if not part.creep and not part.thermoelastic:
            return charge
        steps = np.diff(charge, axis=0, prepend=self._touch[np.newaxis])
        self._touch = charge[-1]
        film: Array = (1.0 - 0.5 * part.creep * np.exp(-1.0 / CREEP_TIMES).sum()) * charge
        shares = np.append(np.full(CREEP_TIMES.size, 0.5 * part.creep), part.thermoelastic)
        for k, (lag, share) in enumerate(zip(np.append(CREEP_TIMES, part.film_time), shares, strict=True)):
            keep = math.exp(-1.0 / (self.rate * lag))
            term, self._memory[k] = scipy.signal.lfilter([share], [1.0, -keep], steps, axis=0, zi=self._memory[k])
            film = film + term
        return film

    @property
    def _share_of_air(self) -> float:
        """Variance of the film's drift over the air's, by the stationary law of a lag behind a lag."""
        return self.amplifier.temperature_time / (self.amplifier.temperature_time + self.amplifier.film_time)

    def _temperature(self, time: Array) -> Array:
        """Temperature of the film above its mean, shape (n,), K: a lag behind the air, whose drift is one, too."""
        part = self.amplifier
        of_air, of_film = (math.exp(-1.0 / (self.rate * lag)) for lag in (part.temperature_time, part.film_time))
        kick = math.sqrt((1.0 - of_air * of_air) / self._share_of_air) * part.temperature_rms
        kicks = kick * self.rng.standard_normal(time.size)
        drift = scipy.signal.lfilter([1.0], [1.0, -of_air], kicks, zi=[of_air * self._warmth[0]])[0]
        since = time - part.step_at
        rise = np.clip(np.minimum(since, part.step_for - since) / part.step_time, 0.0, 1.0)
        air = drift + part.step * rise
        film: Array = scipy.signal.lfilter([1.0 - of_film], [1.0, -of_film], air, zi=[of_film * self._warmth[1]])[0]
        self._warmth = float(drift[-1]), float(film[-1])
        return film

    def _integrate(self, film: Array) -> Array:
        """The amplifier's output, shape (n, electrodes), pC."""
        steps = self.gain * np.diff(film, axis=0, prepend=self._charge[np.newaxis]) + self.bias / self.rate
        self._charge = film[-1]
        keep = np.exp(-1.0 / (self.rate * self.tau))
        output = np.empty_like(steps)
        for k, share in enumerate(keep):
            output[:, k] = scipy.signal.lfilter([1.0], [1.0, -share], steps[:, k], zi=[share * self._output[k]])[0]
        self._output = output[-1]
        return output

    def _convert(self, output: Array) -> Array:
        """The output clipped, and rounded to the converter's steps."""
        limit, bits = self.amplifier.limit, self.amplifier.bits
        clipped = np.clip(output, -limit, limit)
        if not bits:
            return clipped
        step = 2.0 * limit / (1 << bits)
        return np.asarray(np.clip(np.round(clipped / step), -(1 << bits - 1), (1 << bits - 1) - 1) * step)
