"""A contact followed across folds: what several contacts with the same charges are told apart by.

Where the map from contacts to charges folds, one frame has several solutions, and no model can say which it is. A
contact that moves on passes the fold, one that stays on its side turns back just there; so motion and the frames before
tell. The state is (x, y, ln F), its rates, and the logarithm of each gain, which may be off by `GAIN`. Its distribution
is a sum of Gaussians (Alspach and Sorenson 1972), each an iterated extended Kalman filter (Bell and Cathey 1993) of the
charges themselves. A touch begins with some all over the film, of which few explain the charges; one that comes near a
fold gets wings beyond it; one that is surprised, or moves, gets a rival that moves otherwise or stops from now on.
Frames are averaged over `STEP_s`; more often tells hardly more.
"""

import math
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.model.charge_series import ChargeSeries, read_charges
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.prediction.contact import Contact
from isocharge.serve.prediction.predictor import Predictor

STEP_s, SHORT_s = 0.005, 1e-5
"""Time over which charges are averaged, and by how much less does, s: clocks are not exact."""

LONGEST_STEP_s = 1.0
"""Time without a frame after which nothing of the contact is known any more, s."""

GAIN, COLOURED = 0.01, 0.003
"""Standard deviations, over the charge, of a gain about its value, and of what else lasts for some frames."""

SPEED, KINK_SPEED, FORCE_RATE = 30.0, 80.0, 10.0
"""Standard deviations of a speed along x or y, mm/s, as a touch and as a movement begins, and of the rate of ln F, 1/s.
"""

ACCELERATION, CALMEST = 800.0, 0.2
"""Spectral density of the acceleration of what moves with SPEED, mm^2/s^3, in proportion to the square of the speed,
and the least share of it."""

FORCE_CHANGE = 2.0
"""The same for ln F, 1/s^3."""

KINKS = 2.0
"""Movements that begin or end at once, 1/s."""

SURPRISED = 8.0
"""Squared innovation, in variances, from which on a rival moves otherwise."""

AGAIN_s = 0.05
"""Shortest time from one search for the contact, which takes milliseconds, to the next, s."""

LOST = 60.0
"""The same for the best of all: the contact is looked for anew."""

MOST, LEAST_LOG = 8, -14.0
"""Gaussians that are kept, and the logarithm of the weight, over the largest, of the least."""

ALIKE = 0.7
"""Deviations within which two Gaussians are one."""

REACH, WING = 4.0, 2.5
"""Deviations within which a fold gives a Gaussian two wings, and at which they lie, each with half its deviation.

Gains that are off hide a fold: the contact seems to stop short of it, and the Gaussian does not know how far it is."""

NARROW_MM = 0.05
"""Deviation below which a Gaussian needs no wings, mm."""

APART = 3.0
"""Deviations from which on two Gaussians on one side of a fold are different contacts."""

STARTS = 121
"""Gaussians all over the film with which a touch begins."""

STEPS, START_STEPS = 3, 20
"""Steps to the most probable state given the charges, and at first."""

LONGEST_MM, LONGEST_LOG = 0.5, 0.2
"""Longest of these steps, in the place and in ln F: beyond, charges are not what their derivatives say."""

TURNS = 2.399963
"""The golden angle: places that fill a disk evenly (Vogel 1979)."""


class Branch(NamedTuple):
    """One of the contacts that the charges may be of.

    Attributes:
        mean: (x, y, ln F), its rates and the logarithms of the gains, mm, N and s.
        covariance: Of these.
        probability: That it is this one.
        misfit: Distance of the charges from its own, in standard deviations.
    """

    mean: Array
    covariance: Array
    probability: float
    misfit: float

    def after(self, dt_s: float) -> "Branch":
        """The same, moved on for less than a frame or two."""
        mean = self.mean.copy()
        mean[:3] += dt_s * mean[3:6]
        return self._replace(mean=mean)

    @property
    def contact(self) -> Contact:
        """As a model would say it."""
        x, y, log_force = self.mean[:3].tolist()
        std = np.sqrt(self.covariance.diagonal()[:3])
        (_, xy, xF), (_, _, yF), _ = (self.covariance[:3, :3] / np.outer(std, std)).tolist()
        x_std, y_std, relative = std.tolist()
        force = math.exp(log_force)
        return Contact(x, y, force, x_std, y_std, relative * force, self.misfit, xy, xF, yF)

    @property
    def moves(self) -> float:
        """Probability that a contact at rest would seem slower than this one."""
        velocity = self.mean[3:5]
        return -math.expm1(-0.5 * float(velocity @ np.linalg.solve(self.covariance[3:5, 3:5], velocity)))


class Branches:
    """Follows one contact; belongs to one thread. The same frames give the same answers, bit for bit."""

    def __init__(self, charges: ChargeSeries, noise: ModelNoise) -> None:
        """Begin without a contact.

        Args:
            charges: The charges of every contact.
            noise: Noise of a frame, that of the model's training.
        """
        self.charges = charges
        self._noise = noise
        angle, share = TURNS * np.arange(STARTS), np.sqrt((np.arange(STARTS) + 0.5) / STARTS)
        places = charges.radius_mm * share * np.array([np.cos(angle), np.sin(angle)])
        self._places = np.column_stack([*places, np.full(STARTS, np.log(charges.force_N).mean())])
        self.forget()

    def forget(self) -> None:
        """Forget the contact."""
        self._weight, self._misfit = np.zeros(0), 0.0
        self._block: list[tuple[Array, float]] = []
        self._began_s = self._t_s = self._again_s = -math.inf
        self._found: list[Branch] = []

    def update(self, charge_pC: Array, t_s: float) -> list[Branch]:
        """Take a frame in: what the contact may be by now, the most probable first; none if none explains the charges.

        Args:
            charge_pC: Touch charges, shape (n_electrode,), pC.
            t_s: Time of the frame, s, on any clock.
        """
        self._block.append((charge_pC, t_s))
        if not 0.0 <= t_s - self._began_s < STEP_s - SHORT_s:
            charges, times = zip(*self._block, strict=True)
            charge_pC, middle_s, count = np.mean(charges, axis=0), sum(times) / len(times), len(times)
            self._block, self._began_s, dt_s, self._t_s = [], t_s, middle_s - self._t_s, middle_s
            variance = self._noise.variance(charge_pC) / count + (COLOURED * charge_pC) ** 2
            follows = self._weight.size > 0 and 0.0 < dt_s < LONGEST_STEP_s
            if not (follows and self._advance(charge_pC, variance, dt_s)):
                self._weight = np.zeros(0)
                if t_s >= self._again_s:
                    self._again_s = t_s + AGAIN_s
                    self._start(charge_pC, variance)
            self._found = self._branches() if self._weight.size else []
        return [branch.after(t_s - self._t_s) for branch in self._found]

    def _linearised(self, mean: Array) -> tuple[Array, Array]:
        """Charges and their derivatives by the state, (h, e) and (h, e, 6 + e)."""
        charge, slopes = self.charges.linearised(mean[:, :3])
        gains = np.exp(mean[:, 6:])
        charge = charge * gains
        rest = np.zeros((*charge.shape, 3))
        return charge, np.concatenate(
            [slopes * gains[:, :, None], rest, charge[:, :, None] * np.eye(charge.shape[1])], 2
        )

    def _start(self, charge_pC: Array, variance: Array) -> None:
        """Gaussians all over the film, of which those are kept that explain the charges."""
        mean = np.zeros((STARTS, 6 + charge_pC.size))
        mean[:, :3] = self._places
        width = self.charges.radius_mm / math.sqrt(STARTS)
        prior = [width, width, 2.0, SPEED, SPEED, FORCE_RATE, *[GAIN] * charge_pC.size]
        spread = np.tile(np.diag(np.array(prior) ** 2.0), (STARTS, 1, 1))
        self._weight = np.zeros(STARTS)
        if not self._take(mean, spread, charge_pC, variance, START_STEPS):
            self._weight = np.zeros(0)

    def _advance(self, charge_pC: Array, variance: Array, dt_s: float) -> bool:
        """Take an average in; False if no Gaussian explains it."""
        mean, spread = self._moved(dt_s)
        charge, slopes = self._linearised(mean)
        off, total = charge_pC - charge, slopes @ spread @ slopes.swapaxes(1, 2) + np.diag(variance)
        best = int(self._weight.argmax())
        surprised = off[best] @ np.linalg.solve(total[best], off[best]) > SURPRISED
        if surprised or np.hypot(*mean[best, 3:5]) > SPEED:
            mean, spread = np.vstack([mean, mean[best]]), np.concatenate([spread, spread[best, None]])
            if surprised:
                kink = np.array([KINK_SPEED, KINK_SPEED, FORCE_RATE]) ** 2
                spread[-1, range(3, 6), range(3, 6)] += kink
                spread[-1, range(3), range(3)] += kink * dt_s**2
            else:
                mean[-1, :3] -= dt_s * mean[-1, 3:6]
                mean[-1, 3:6] = 0.0
            self._weight = np.append(self._weight, self._weight[best] + math.log(KINKS * dt_s))
        return self._take(mean, spread, charge_pC, variance, STEPS)

    def _take(self, mean: Array, spread: Array, charge_pC: Array, variance: Array, steps: int) -> bool:
        """Take charges in by so many steps to the most probable state; False if no Gaussian explains them."""
        found, noise = mean.copy(), np.diag(variance)
        for number in range(steps + 1):
            charge, slopes = self._linearised(found)
            reached = slopes @ spread
            from_state = reached @ slopes.swapaxes(1, 2)
            off = charge_pC - charge - ((mean - found)[:, None] @ slopes.swapaxes(1, 2))[:, 0]
            weighed = np.linalg.solve(from_state + noise, off[:, :, None])
            if number < steps:
                step = mean + (reached.swapaxes(1, 2) @ weighed)[:, :, 0] - found
                longest = np.maximum(np.hypot(step[:, 0], step[:, 1]) / LONGEST_MM, np.abs(step[:, 2]) / LONGEST_LOG)
                found += step / np.maximum(longest, 1.0)[:, None]
        misfit = ((charge_pC - charge) ** 2 / variance).sum(axis=1)
        square = misfit + (weighed.swapaxes(1, 2) @ from_state @ weighed)[:, 0, 0]
        weight = self._weight - 0.5 * (square + np.linalg.slogdet(from_state + noise)[1])
        weight[np.hypot(found[:, 0], found[:, 1]) > 1.1 * self.charges.radius_mm] = -np.inf
        best = int(weight.argmax())
        if not (square[best] < LOST and np.isfinite(weight[best])):
            return False
        spread = spread - reached.swapaxes(1, 2) @ np.linalg.solve(from_state + noise, reached)
        self._misfit = math.sqrt(misfit[best])
        self._mean, self._spread, self._weight = found, 0.5 * (spread + spread.swapaxes(1, 2)), weight - weight[best]
        self._prune()
        self._split()
        return True

    def _moved(self, dt_s: float) -> tuple[Array, Array]:
        """Means and covariances after so much time."""
        mean, on = self._mean.copy(), np.eye(self._mean.shape[1])
        on[range(3), range(3, 6)] = dt_s
        mean[:, :3] += dt_s * mean[:, 3:6]
        spread = on @ self._spread @ on.T
        fast = np.maximum((mean[:, 3:5] ** 2).sum(axis=1) / SPEED**2, CALMEST)
        for axis, density in ((0, ACCELERATION * fast), (1, ACCELERATION * fast), (2, FORCE_CHANGE)):
            spread[:, axis, axis] += density * dt_s**3 / 3.0
            spread[:, axis, 3 + axis] += density * dt_s**2 / 2.0
            spread[:, 3 + axis, axis] += density * dt_s**2 / 2.0
            spread[:, 3 + axis, 3 + axis] += density * dt_s
        return mean, spread

    def _prune(self) -> None:
        """Drop what is improbable, and make one of what is alike."""
        order = np.argsort(-self._weight, kind="stable")
        kept: list[int] = []
        for row in order[self._weight[order] > LEAST_LOG]:
            std = np.sqrt(self._spread[row].diagonal()[:6])
            for other in kept:
                if (np.abs(self._mean[row, :6] - self._mean[other, :6]) < ALIKE * std).all():
                    self._weight[other] = np.logaddexp(self._weight[other], self._weight[row])
                    break
            else:
                kept.append(int(row))
        del kept[MOST:]
        self._mean, self._spread, self._weight = self._mean[kept], self._spread[kept], self._weight[kept]

    def _split(self) -> None:
        """Give the most probable Gaussian two wings where it spreads over a fold."""
        best = int(self._weight.argmax())
        mean, spread = self._mean[best], self._spread[best]
        values, axes = np.linalg.eigh(spread[:2, :2])
        std = math.sqrt(max(values[1], 0.0))
        if std < NARROW_MM or len(self._mean) > MOST - 2:
            return
        reach = spread[:, :2] @ axes[:, 1] / std
        wings = mean + WING * np.outer([1.0, -1.0], reach)
        if self._turned(mean, mean + REACH * np.outer([1.0, -1.0], reach)).any():
            narrow = spread - 0.75 * np.outer(reach, reach)
            self._mean, self._spread = np.vstack([self._mean, wings]), np.concatenate([self._spread, [narrow, narrow]])
            self._weight = np.append(self._weight, [self._weight[best] - 0.5 * WING**2] * 2)

    def _turned(self, one: Array, others: Array) -> Booleans:
        """Whether the map turns over between a contact and others, shape (n, state)."""
        slopes = self.charges.linearised(np.vstack([one, others])[:, :3])[1]
        return np.asarray(np.linalg.det(slopes[0].T @ slopes[1:]) < 0.0)

    def _branches(self) -> list[Branch]:
        """The Gaussians, those of one contact together."""
        share = np.exp(self._weight - self._weight.max())
        share /= share.sum()
        left, branches = np.argsort(-share, kind="stable"), []
        while left.size:
            one = self._mean[left[0]]
            std = np.sqrt(self._spread[left[0], range(2), range(2)] + self._spread[left][:, range(2), range(2)])
            near = (np.abs(self._mean[left, :2] - one[:2]) < APART * std).all(axis=1)
            near &= ~self._turned(one, self._mean[left])
            near[0] = True
            rows = left[near]
            part = share[rows] / share[rows].sum()
            mean = part @ self._mean[rows]
            off = self._mean[rows] - mean
            covariance = np.tensordot(part, self._spread[rows], 1) + (part[:, None] * off).T @ off
            branches.append(Branch(mean, covariance, float(share[rows].sum()), self._misfit))
            left = left[~near]
        return sorted(branches, key=lambda branch: -branch.probability)


def branches_of(predictor: Predictor) -> Branches | None:
    """What follows a contact of a film that folds; None if its model has no `charges.npz`.

    Raises:
        ModelError: If the file is damaged.
    """
    charges = read_charges(predictor.folder, len(predictor.metadata.electrodes))
    return None if charges is None else Branches(charges, predictor.metadata.noise)
