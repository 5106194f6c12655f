"""The pretension of a film, followed by ordinary touches whose place and force nobody knows.

Four charges have one number to spare for three unknowns: the misfit. A film that has become tauter or slacker, as by a
degree of the room, lets the misfits of all touches grow, and the pretension at which they are least is the film's. It
is estimated by Bayes' rule on a fixed set of pretensions, with a random walk between touches; one touch gives one
number, by its hardest frame. Gains drift as well, those of each electrode by 1 % about one, and the misfits of touches
are linear in them: at every pretension there is a Kalman filter for the gains (Rao and Blackwell's way, Doucet et al.
2000), so that what gains explain as well is not taken for a change of the film. A touch that no pretension explains
says next to nothing. When the last ones are of that kind (two contacts, the warmth of a hand), or are explained far
better by a gain that is wrong, the film is not followed any farther: the model answers for the film as it was before
them.
"""

import math
from collections import deque
from functools import partial

import numpy as np

from isocharge.common.arrays import Array, Reals
from isocharge.common.errors import ModelError
from isocharge.serve.flags import BEYOND, GAP, MISFIT, OUTSIDE, REPEAT, STRESS
from isocharge.serve.model.pretensions import read_pretensions
from isocharge.serve.prediction.contact import Contact, Sensitivity
from isocharge.serve.prediction.predictor import Predictor
from isocharge.serve.record.record import FollowedFilm
from isocharge.serve.signal_chain.rule import Rule, Setting

STEP_MPa = 0.01
"""Distance of the pretensions that are compared."""

COARSE_MPa = 0.1
"""Distance of those at which the network is evaluated."""

HARMLESS = frozenset({STRESS, GAP, REPEAT})
"""Flags of frames after which the other frames of a touch still count: the last two say that frames were lost."""

LIGHT = HARMLESS | {OUTSIDE, BEYOND, MISFIT}
"""The same where a touch is outside the model's forces or its area, as every touch is at its begin."""

JUMP = 1e-4
"""Chance between two touches of a change that is no drift: everything is as probable then."""

STRAY, STRAY_DENSITY = 0.05, np.exp(-4.5)
"""Share of touches that are something else, and their density at any misfit, over that of a good one without."""

RECENT, FEWEST = 40, 12
"""Touches by which it is judged whether any pretension explains them, and with how few that begins."""

LARGEST_SQUARE = 9.0
"""Square of the misfit, over its mean square, up to which a touch counts in that judgement."""

EXPLAINED, SCATTER = 1.25, 5.0
"""Mean square up to which touches are explained, for very many of them, and what is added over the root of theirs."""

GAIN = 0.01
"""Standard deviation of the drift of a gain, and step of the differences by it."""

GAIN_s = 1800.0
"""Time in which a gain forgets where it was (Ornstein-Uhlenbeck): less, and a film that changes is followed late."""

GAINS = np.outer([-1.0, 1.0], [0.03, 0.04, 0.06, 0.09]).ravel()
"""Wrong gains that are tried on each electrode in the place of another pretension."""

BETTER = 9.0
"""Sum of squares by which one of them must be better than any pretension to be believed."""

BESIDE_MPa = 0.05
"""Distance of the pretension by which it is told how contacts depend on it."""

NEWS_MPa = 0.01
"""Change of the pretension from which the model's weights are made anew."""


class FollowRule(Rule, frozen=True, kw_only=True):
    """How a film is followed; the section `[follow]` of a device file.

    Attributes:
        drift_MPa_per_root_hour: Standard deviation of the pretension's change in an hour; it grows with the root of
            the time. A degree is 0.3 to 0.44 MPa on a ring of aluminium.
    """

    drift_MPa_per_root_hour: Setting = 0.35


class FilmFollower:
    """Follows one film; belongs to one thread. The same frames give the same answers, bit for bit.

    Attributes:
        predictor: The model of the film as it is now.
        is_lost: Whether the last touches fit this film at no pretension, so that it is not followed.
    """

    def __init__(self, predictor: Predictor, rule: FollowRule | None = None) -> None:
        """Begin with the film as it was calibrated; by default with the settings of an empty section.

        Raises:
            ModelError: If the model has three electrodes, or nothing to follow with, or that is of another model.
        """
        electrodes, label = predictor.metadata.electrodes, predictor.metadata.label
        if len(electrodes) <= 3:
            raise ModelError(
                f"model {label}: its film cannot be followed: {len(electrodes)} charges {electrodes} are used up by x, "
                "y and force, and nothing is left that tells of the film; with four electrodes one charge is to spare"
            )
        self._calibrated, self._known = predictor, read_pretensions(predictor.folder)
        low, high = self._known.range_MPa
        self._grid = np.linspace(low, high, max(round((high - low) / STEP_MPa), 1) + 1)
        self._films = self._known.at(np.linspace(low, high, max(round((high - low) / COARSE_MPa), 1) + 1))
        self._gains = 1.0 + np.kron(np.eye(len(electrodes)), GAINS[:, None])
        self._drift = (rule or FollowRule()).drift_MPa_per_root_hour
        self._check()
        self.back()

    def _check(self) -> None:
        """Refuse a file of another model: the graph must answer as it does by itself, and otherwise at another end."""
        known, charges = self._known, np.outer([0.5, 1.0, 2.0], self._known.typical_pC)
        own = np.asarray(self._calibrated.predict_batch(charges))
        same, other = (
            np.asarray(self._calibrated.with_constants(known.constants(pretension)).predict_batch(charges))
            for pretension in (known.calibrated_MPa, known.range_MPa[known.calibrated_MPa == known.range_MPa[0]])
        )
        if not np.allclose(same, own, rtol=1e-5, atol=1e-5, equal_nan=True) or np.array_equal(other, own):
            raise ModelError(
                f"{self._calibrated.folder}: pretensions.npz is not of this model.onnx; copy the model's folder again, "
                "or calibrate again"
            )

    def back(self) -> None:
        """Go back to the film as it was calibrated, and follow it anew."""
        known = self._known
        self.predictor, self.is_lost = self._calibrated, False
        self._answered_MPa, self._answered_std = known.calibrated_MPa, known.std_MPa
        self._probability = _normal(self._grid - known.calibrated_MPa, known.std_MPa)
        self._gain = np.zeros((self._grid.size, known.typical_pC.size))
        self._spread = np.tile(np.eye(known.typical_pC.size), (self._grid.size, 1, 1))
        self._beside: Predictor | None = None
        self._when_s: float | None = None
        self._touches, self._walked = 0, 0.0
        self._recent: deque[tuple[Array, ...]] = deque(maxlen=RECENT)
        self._earlier: deque[tuple[float, float]] = deque(maxlen=RECENT)
        self.forget()

    def forget(self) -> None:
        """Forget the touch that is under way, as after an outage or a new tare."""
        self._hardest: tuple[float, Array] | None = None
        self._spoiled = False

    @property
    def film(self) -> FollowedFilm:
        """The film by now."""
        return FollowedFilm(self._answered_MPa, self._answered_std, self._touches)

    def see(self, charge_pC: Array | None, contact: Contact | None, flags: tuple[str, ...], clock_s: float) -> None:
        """Take in a frame; a touch counts when it is over.

        Args:
            charge_pC: Touch charges, shape (n_electrode,), pC.
            contact: The model's answer to them; None where nothing touches.
            flags: Of the frame.
            clock_s: When, on a clock that does not jump, s.
        """
        if contact is not None:
            if not flags:
                if self._hardest is None or contact.force_N > self._hardest[0]:
                    assert charge_pC is not None
                    self._hardest = contact.force_N, charge_pC
            elif not (LIGHT if OUTSIDE in flags else HARMLESS).issuperset(flags):
                self._spoiled = True
        elif self._hardest is not None or self._spoiled:
            if self._hardest is not None and not self._spoiled:
                self.take(self._hardest[1], clock_s)
            self.forget()

    def widened(self, contact: Contact, charge_pC: Array) -> Contact:
        """A contact of the model with what is not known of the pretension in its deviations, once it is followed."""
        if self._beside is None:
            return contact
        beside = partial(self._beside.predict, charge_pC)
        return contact.widened(self._sensitivity.shift(contact, self._answered_std, beside))

    def take(self, charge_pC: Array, clock_s: float) -> None:
        """Take in a touch, charges of shape (n_electrode,), pC."""
        self._walk(clock_s)
        nudged = np.vstack([np.ones_like(charge_pC), 1.0 + GAIN * np.eye(charge_pC.size)])
        vectors = self._films.vectors(charge_pC * nudged, self._grid) / self._known.misfit_rms
        by_gain = np.moveaxis(vectors[1:] - vectors[0], 0, 2)  # for each pretension (n_electrode, n_gain)
        reached = by_gain @ self._spread
        expected = np.eye(charge_pC.size) + reached @ by_gain.swapaxes(1, 2)
        surprise = vectors[0] - (by_gain @ self._gain[:, :, None])[:, :, 0]
        weighed = np.linalg.solve(expected, np.concatenate([surprise[:, :, None], reached], axis=2))
        square = (surprise * weighed[:, :, 0]).sum(axis=1)
        good = (1.0 - STRAY) * np.exp(-0.5 * square) / np.sqrt(np.linalg.det(expected))
        believed = good / (good + STRAY * STRAY_DENSITY)
        self._gain = self._gain + believed[:, None] * (reached.swapaxes(1, 2) @ weighed[:, :, :1])[:, :, 0]
        self._spread = self._spread - believed[:, None, None] * (reached.swapaxes(1, 2) @ weighed[:, :, 1:])
        posterior = self._probability * (good + STRAY * STRAY_DENSITY)
        self._probability = posterior / posterior.sum()
        self._touches += 1
        mean = float(self._probability @ self._grid)
        nearest = np.abs(self._grid - mean).argmin()
        left = vectors[0] - (by_gain @ self._gain[:, :, None])[:, :, 0]
        models, scaled = (self._calibrated, self.predictor), charge_pC * self._gains
        rivals = np.concatenate([model.predict_batch(scaled).misfit for model in models]) / self._known.misfit_rms
        vectors_of = (left, vectors[0], rivals[:, None].astype(float), left[nearest, None])
        self._recent.append(tuple(np.minimum((each**2).sum(axis=1), LARGEST_SQUARE) for each in vectors_of))
        self._judge(mean, nearest)

    def _walk(self, clock_s: float) -> None:
        """Widen the distribution by the drift since the touch before, and by what may have changed at once."""
        seconds = 0.0 if self._when_s is None else max(clock_s - self._when_s, 0.0)
        self._when_s, self._walked = clock_s, self._walked + self._drift**2 * seconds / 3600.0
        kept = math.exp(-seconds / GAIN_s)
        spread = kept**2 * self._spread + (1.0 - kept**2) * np.eye(self._gain.shape[1])
        gains = np.concatenate([kept * self._gain, spread.reshape(self._grid.size, -1)], axis=1)
        mass = self._probability[:, None] * np.column_stack([np.ones(self._grid.size), gains])
        if (std := float(np.sqrt(self._walked))) >= STEP_MPa:
            reach = min(round(4.0 * std / STEP_MPa), self._grid.size)
            kernel = _normal(STEP_MPa * np.arange(-reach, reach + 1.0), std)
            padded = np.pad(mass, ((reach, reach), (0, 0)), mode="edge")
            mass = sum(share * padded[n : n + self._grid.size] for n, share in enumerate(kernel))
            mass, self._walked = mass / mass[:, 0].sum(), 0.0
        mass = (1.0 - JUMP) * mass + JUMP / self._grid.size * mass.sum(axis=0)
        self._probability, gains = mass[:, 0], mass[:, 1:] / mass[:, :1]
        self._gain, spread = np.split(gains, [self._gain.shape[1]], axis=1)
        self._spread = spread.reshape(self._spread.shape)

    def _judge(self, mean: float, nearest: np.intp) -> None:
        """Answer for the film that the last touches tell if it explains them, else for that before them."""
        if (count := len(self._recent)) < FEWEST:
            return
        squares, alone, rivals, drifting = (sum(column) for column in zip(*self._recent, strict=True))
        square = min(squares[nearest], drifting[0])
        unexplained = square > EXPLAINED * count + SCATTER * math.sqrt(count)
        was_lost, self.is_lost = self.is_lost, bool(unexplained or rivals.min() < alone.min() - BETTER)
        if not self.is_lost:
            self._earlier.append(self._changed(mean))
            self._answer(*self._earlier[-1])
        elif not was_lost:
            full = len(self._earlier) == RECENT
            self._answer(*(self._earlier[0] if full else (self._known.calibrated_MPa, self._known.std_MPa)))
            self._earlier.clear()

    def _changed(self, mean: float) -> tuple[float, float]:
        """Pretension and its deviation, where films that have changed and have not are as probable beforehand."""
        change = mean - self._known.calibrated_MPa
        still = float(self._probability @ (self._grid - mean) ** 2) + self._known.floor_MPa**2
        drifted = still + self._known.std_MPa**2
        against = math.sqrt(drifted / still) * math.exp(-0.5 * change**2 * (1.0 / still - 1.0 / drifted))
        share = 1.0 / (1.0 + against)
        std = math.sqrt(still + share * (1.0 - share) * change**2)
        return self._known.calibrated_MPa + share * change, std

    def _answer(self, pretension_MPa: float, std: float) -> None:
        """Make the model of this pretension the one that answers."""
        self._answered_std = std
        if abs(pretension_MPa - self._answered_MPa) >= NEWS_MPa:
            self._answered_MPa = pretension_MPa
            self.predictor = self._at(pretension_MPa)
        elif self._beside is not None:
            return
        side = -BESIDE_MPa if self._answered_MPa + BESIDE_MPa > self._grid[-1] else BESIDE_MPa
        self._beside, self._sensitivity = self._at(self._answered_MPa + side), Sensitivity(BESIDE_MPa)

    def _at(self, pretension_MPa: float) -> Predictor:
        return self._calibrated.with_constants(self._known.constants(pretension_MPa))


def _normal(deviation: Reals, std: float) -> Array:
    density = np.exp(-0.5 * (deviation / std) ** 2)
    return np.asarray(density / density.sum())
