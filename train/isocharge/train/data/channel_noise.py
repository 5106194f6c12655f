"""Noise of measured presses, learned from them: what neighbours in place and force do not share.

A plane through the nearest presses predicts the charges of the press in their midst. What is left over is noise of the
channels, and of the rig that does not know place and force exactly: s^2 = white^2 + (gain * Q)^2, for each channel.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import cKDTree

from isocharge.common.arrays import Array
from isocharge.simulate import NoiseModel

NEIGHBOURS = 16
"""Presses that a plane is put through, four for each of its coefficients."""

ROUNDS = 10
"""Weighted least squares in turn: each has the variances that the one before found."""

OUTLIER = 3.0
"""Standard deviations beyond which a residual counts as this many: a knock against the rig is no noise."""

LEAST_SHARE = 0.01
"""Least white noise over gain, relative to the usual size of a channel's charges: where no charge is small, the presses
do not tell the white noise."""

BOTH_SIGNS = 0.01
"""Share of presses from which on the rarer sign of a channel's charges counts, dimensionless."""

LEAST_BEND = 0.5
"""Least charge of such a channel from which features are logarithmic, relative to the usual size: without noise they
would have a kink where the charge changes its sign."""

LARGEST_EXPONENT = 50.0
"""Of charges from levels: 1e21 times the white noise over gain is no charge."""

LEAST_GAIN = 1e-4
"""Least gain, dimensionless: that of a good amplifier. It keeps asinh(gain Q / white) / gain apart from Q / white."""

CANDIDATES = 8
"""Planes among which the nearest is looked for."""


@dataclass(frozen=True)
class ChannelNoise:
    """As `NoiseModel`, with numbers of its own for each channel, shape (n_electrode,).

    Attributes:
        white: Standard deviation that every reading has, pC.
        gain: Standard deviation in proportion to the charge, dimensionless.
    """

    white: Array
    gain: Array
    name: str = "measured"

    @classmethod
    def of(cls, charge: Array, unit: Array) -> "ChannelNoise":
        """Learn it from measured charges, shape (n, n_electrode), pC, and contacts of one scale, shape (n, 3)."""
        planes = LocalPlanes.through(unit, charge)
        fits = [_variance(*columns) for columns in zip(planes.value.T, planes.residual.T, strict=True)]
        white, gain = np.sqrt(np.array(fits)).T
        gain = np.maximum(gain, LEAST_GAIN)
        return cls(np.maximum(white, LEAST_SHARE * gain * usual_size(charge)), gain)

    @classmethod
    def alike(cls, noise: NoiseModel, electrodes: int) -> "ChannelNoise":
        """The same noise on every one of so many channels."""
        return cls(np.full(electrodes, noise.white), np.full(electrodes, max(noise.gain, LEAST_GAIN)), noise.name)

    def sigma(self, charge: Array) -> Array:
        """Standard deviation for charges of shape (n, n_electrode), pC; the same shape."""
        return np.asarray(np.hypot(self.white, self.gain * charge))

    def add(self, charge: Array, rng: np.random.Generator) -> Array:
        """Noisy readings of charges of shape (n, n_electrode), pC."""
        return np.asarray(charge + self.sigma(charge) * rng.standard_normal(charge.shape))

    def level(self, charge: Array) -> Array:
        """Charges of shape (n, n_electrode), pC, in units in which their noise is 1: asinh(gain Q / white) / gain."""
        return np.asarray(np.arcsinh(charge * self.gain / self.white) / self.gain)

    def charge(self, level: Array) -> Array:
        """The inverse of `level`, pC."""
        exponent = np.clip(level * self.gain, -LARGEST_EXPONENT, LARGEST_EXPONENT)
        return np.asarray(np.sinh(exponent) * self.white / self.gain)

    def bend(self, charge: Array) -> Array:
        """Sizes from which features of charges (n, n_electrode) are logarithmic, shape (n_electrode,), pC."""
        rarer = np.minimum(np.mean(charge > 0.0, axis=0), np.mean(charge < 0.0, axis=0))
        least = np.where(rarer > BOTH_SIGNS, LEAST_BEND * usual_size(charge), 0.0)
        return np.asarray(np.maximum(self.white / self.gain, least))

    def scaled(self, factor: float) -> "ChannelNoise":
        """The same noise, larger by a factor."""
        return ChannelNoise(factor * self.white, factor * self.gain, self.name)

    def to_dict(self) -> dict[str, object]:
        """For metadata."""
        white, gain = ([float(f"{number:.4g}") for number in row] for row in (self.white, self.gain))
        return {"name": self.name, "white_pC": white, "gain": gain}


@dataclass(frozen=True)
class LocalPlanes:
    """Planes through the neighbours of each press, the press itself left out.

    Attributes:
        value: At the press, shape (n, k).
        slope: Derivatives by the unit coordinates, shape (n, k, 3).
        residual: Of the press, over the root of 1 + the plane's own variance, shape (n, k).
        reach: Distance of the farthest neighbour, shape (n,).
    """

    value: Array
    slope: Array
    residual: Array
    reach: Array

    @classmethod
    def through(cls, unit: Array, values: Array) -> "LocalPlanes":
        """Planes of values (n, k) over places (n, 3)."""
        distance, near = cKDTree(unit).query(unit, NEIGHBOURS + 1)
        near = near[:, 1:]
        columns = np.concatenate([np.ones((*near.shape, 1)), unit[near] - unit[:, None]], axis=2)
        solver = np.linalg.pinv(columns)
        plane = solver @ values[near]
        spread = np.sqrt(1.0 + (solver[:, :1] ** 2).sum(axis=2))
        return cls(plane[:, 0], plane[:, 1:].swapaxes(1, 2), (values - plane[:, 0]) / spread, distance[:, -1])

    def residuals(self, values: Array) -> Array:
        """Values (m, k) less the nearest that any plane has within its reach, shape (m, k)."""
        near = cKDTree(self.value).query(values, CANDIDATES)[1]
        inverse = np.linalg.pinv(self.slope)
        best = np.full(values.shape, np.inf)
        for rows in near.T:
            off = values - self.value[rows]
            step = (inverse[rows] @ off[..., None])[..., 0]
            length = np.linalg.norm(step, axis=1)
            step *= np.minimum(1.0, self.reach[rows] / np.maximum(length, 1e-30))[:, None]
            left = off - (self.slope[rows] @ step[..., None])[..., 0]
            nearer = (left**2).sum(axis=1) < (best**2).sum(axis=1)
            best[nearer] = left[nearer]
        return best


def usual_size(charge: Array) -> Array:
    """Median size of the charges that are not 0, shape (n_electrode,), of (n, n_electrode), pC; none may be 0 alone."""
    return np.array([np.median(np.abs(column[column != 0.0])) for column in charge.T])


def _variance(value: Array, residual: Array) -> tuple[float, float]:
    """white^2 and gain^2 of one channel, from its charges and residuals, shape (n,): weighted least squares."""
    columns = np.stack([np.ones_like(value), value**2], axis=1)
    fit = np.array([np.mean(residual**2), 0.0])
    for _ in range(ROUNDS):
        expected = np.maximum(columns @ fit, 1e-12 * np.mean(residual**2) + 1e-30)
        squares = np.minimum(residual**2, OUTLIER**2 * expected)
        scale = np.sqrt(np.maximum((columns**2).sum(axis=0), 1e-30)) / np.sqrt(len(value))
        fit = nnls(columns / scale / expected[:, None], squares / expected)[0] / scale
    return float(fit[0]), float(fit[1])


Noise = NoiseModel | ChannelNoise
"""Noise of readings: one for all channels, or one for each."""
