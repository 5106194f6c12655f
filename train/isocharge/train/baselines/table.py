"""The lookup table over forces and positions, the second remedy of Mirbagheri et al. (2007): nearest entry, or
interpolated.

Entries are presses; the nearest is found by a KD-tree on whitened logarithms of the charges. The interpolated table
keeps an affine map from features to contact with every entry, fitted by least squares to its neighbourhood. Larger
neighbourhoods of noisy entries average the noise, smaller ones of clean entries follow the map: validation decides.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from isocharge.common.arrays import Array
from isocharge.train.baselines.estimator import Fitted, FittingTask, best_of
from isocharge.train.baselines.features import RULERS, LogFeatures
from isocharge.train.data.domain import ContactDomain

INTERPOLATED = "lookup table, interpolated"

CHUNK = 100_000
"""Neighbours gathered at once."""

RIDGE = 1e-6
"""Relative ridge of an affine map: neighbours may lie in a plane."""


@dataclass(frozen=True)
class NearestEntry:
    """The table as it stands: clean entries, the nearest wins."""

    name: str = "lookup table, nearest entry"

    def fit(self, task: FittingTask) -> tuple[Fitted, ...]:
        """All training presses are entries; nothing is chosen."""
        features = LogFeatures.fit(task.train.charge_pC)
        unit = task.domain.to_unit(task.train.contact)
        maps = np.concatenate([np.zeros((len(unit), features.shift.size, 3)), unit[:, None]], axis=1)
        table = AffineTable(features, cKDTree(features(task.train.charge_pC)), maps, task.domain, self.name)
        return (replace(table, choice=f"{len(unit)} clean entries", affine=False),)


@dataclass(frozen=True)
class InterpolatedTable:
    """The table with local linear interpolation.

    Attributes:
        candidates: What the affine maps are fitted to: "clean" or "noisy" presses, how many of them, and the ruler
            of the axes by which they are near.
        copies: Noisy copies of the presses.
    """

    candidates: tuple[tuple[str, int, tuple[float, float]], ...] = (
        ("clean", 16, RULERS[0]),
        ("noisy", 64, RULERS[0]),
        *(("noisy", count, ruler) for ruler in RULERS[1:] for count in (64, 128)),
    )
    copies: int = 5
    name: str = INTERPOLATED

    def fit(self, task: FittingTask) -> tuple[Fitted, ...]:
        """Choose the neighbourhoods: their size, their metric, and whether their presses are noisy."""
        noisy = task.noisy_train(1 if task.quick else self.copies)
        whitened = LogFeatures.fit(noisy.charge_pC)

        def table(candidate: tuple[str, int, tuple[float, float]]) -> AffineTable:
            kind, count, ruler = candidate
            learnt, features = noisy if kind == "noisy" else task.train, whitened.measured_by(ruler)
            entries = features(task.train.charge_pC)
            maps = affine_maps(entries, features(learnt.charge_pC), task.domain.to_unit(learnt.contact), count)
            return AffineTable(features, cKDTree(entries), maps, task.domain, self.name)

        tables = {
            candidate: table(candidate) for candidate in (self.candidates[1:2] if task.quick else self.candidates)
        }
        best, comparison = best_of(task, tables, lambda candidate: tables[candidate].predict)
        learnt = f"{best[1]} {best[0]} neighbours, force axis x {best[2][0]:g}"
        choice = f"{len(task.train)} entries, affine maps through {learnt}{comparison}"
        return (replace(tables[best], choice=choice),)


def affine_maps(entries: Array, features: Array, unit: Array, count: int) -> Array:
    """For each entry the affine map that fits its nearest presses best.

    Args:
        entries: Features of the entries, shape (m, n_electrode).
        features: Features of the presses, shape (n, n_electrode).
        unit: Their contacts in unit coordinates, shape (n, 3).
        count: Size of a neighbourhood.

    Returns:
        Shape (m, n_electrode + 1, 3): (feature - entry, 1) times the map is the contact.
    """
    tree = cKDTree(features)
    parts = []
    chunk = max(1, CHUNK // count)
    for start in range(0, len(entries), chunk):
        at = entries[start : start + chunk]
        rows = tree.query(at, min(count, len(unit)))[1]
        parts.append(_least_squares(features[rows] - at[:, None], unit[rows]))
    return np.concatenate(parts)


def _least_squares(offset: Array, unit: Array) -> Array:
    """Affine maps from offsets (m, k, n_electrode) to contacts (m, k, 3), with a ridge on the slopes."""
    columns = np.concatenate([offset, np.ones((*offset.shape[:2], 1))], axis=2)
    normal = columns.transpose(0, 2, 1) @ columns
    slopes = np.trace(normal[:, :-1, :-1], axis1=1, axis2=2)[:, None] * np.ones(offset.shape[2])
    ridge = np.concatenate([RIDGE * slopes, np.zeros((len(normal), 1))], axis=1)
    normal += ridge[:, :, None] * np.eye(ridge.shape[1])
    maps: Array = np.linalg.solve(normal, columns.transpose(0, 2, 1) @ unit)
    return maps


@dataclass(frozen=True)
class AffineTable(Fitted):
    """Entries with affine maps.

    Attributes:
        features: Of the charges.
        tree: Features of the entries.
        maps: See `affine_maps`.
        domain: What the unit coordinates refer to.
        affine: Whether the slopes are used; the entry's contact if not.
    """

    features: LogFeatures
    tree: cKDTree
    maps: Array
    domain: ContactDomain
    name: str
    choice: str = ""
    affine: bool = True
    form: str = "SciPy KD-tree"

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        features = self.features(charge_pC)
        rows = self.tree.query(features)[1]
        unit = self.maps[rows, -1]
        if self.affine:
            unit = unit + np.einsum("ne,nek->nk", features - self.tree.data[rows], self.maps[rows, :-1])
        return self.domain.to_contact(unit)

    def one(self, charge_pC: Array) -> Callable[[], object]:
        """See `Fitted.one`."""
        charge, entries = np.array(charge_pC, dtype=float), np.array(self.tree.data)
        centre, scale = self.domain.centre, self.domain.scale

        def compute() -> Array:
            features = self.features(charge)
            row = self.tree.query(features)[1]
            unit = self.maps[row, -1]
            if self.affine:
                unit = (features - entries[row]) @ self.maps[row, :-1] + unit
            contact: Array = unit * scale + centre
            contact[2] = np.exp(contact[2])
            return contact

        return compute
