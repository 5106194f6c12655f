"""k-nearest neighbours: a global affine fit, and the mean of its residuals over the noisy presses whose features lie
nearest.

With enough noisy copies the mean over neighbours tends to the posterior mean, the best there is. The affine fit carries
the force, so that neighbours of other forces do no harm. The direct form asks SciPy's KD-tree without scikit-learn's
checks.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree
from sklearn.linear_model import LinearRegression
from sklearn.neighbors import KNeighborsRegressor

from isocharge.common.arrays import Array
from isocharge.train.baselines.estimator import Fitted, FittingTask, best_of
from isocharge.train.baselines.features import RULERS, LogFeatures, affine_fit, with_one
from isocharge.train.data.domain import ContactDomain

NAME = "k-nearest neighbours"


@dataclass(frozen=True)
class NearestNeighbours:
    """The method.

    Attributes:
        counts: Candidates for k.
        rulers: Candidates for the metric, see `LogFeatures.measured_by`.
    """

    counts: tuple[int, ...] = (16, 32, 64)
    rulers: tuple[tuple[float, float], ...] = RULERS
    name: str = NAME

    def fit(self, task: FittingTask) -> tuple[Fitted, ...]:
        """Choose k and the metric, and give both forms."""
        noisy = task.noisy_train(1 if task.quick else task.copies)
        whitened, unit = LogFeatures.fit(noisy.charge_pC), task.domain.to_unit(noisy.contact)
        candidates: dict[tuple[int, tuple[float, float]], TreeNeighbours] = {}
        for ruler in self.rulers[1:2] if task.quick else self.rulers:
            features = whitened.measured_by(ruler)
            tree = cKDTree(features(noisy.charge_pC))
            plane = affine_fit(np.asarray(tree.data), unit)
            residual = unit - with_one(np.asarray(tree.data)) @ plane
            for count in self.counts:
                candidates[count, ruler] = TreeNeighbours(features, tree, plane, residual, count, task.domain)
        best, comparison = best_of(task, candidates, lambda candidate: candidates[candidate].predict)
        choice = f"k = {best[0]} of {len(unit)} noisy presses, force axis x {best[1][0]:g}{comparison}"
        direct = replace(candidates[best], choice=choice)
        return SklearnNeighbours.of(direct), direct


@dataclass(frozen=True)
class TreeNeighbours(Fitted):
    """SciPy's KD-tree, a mean, and an affine map.

    Attributes:
        features: Of the charges.
        tree: Features of the presses, shape (n, n_electrode).
        plane: The affine fit from features and one to unit coordinates, shape (n_electrode + 1, 3).
        residual: What it leaves of each press, shape (n, 3).
        k: How many count.
        domain: What the unit coordinates refer to.
    """

    features: LogFeatures
    tree: cKDTree
    plane: Array
    residual: Array
    k: int
    domain: ContactDomain
    choice: str = ""
    name: str = NAME
    form: str = "SciPy KD-tree"

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        features = self.features(charge_pC)
        rows = self.tree.query(features, self.k)[1]
        mean = self.residual[rows].reshape(len(charge_pC), self.k, 3).mean(axis=1)
        return self.domain.to_contact(with_one(features) @ self.plane + mean)

    def one(self, charge_pC: Array) -> Callable[[], object]:
        """See `Fitted.one`: units and scales are in what is added up."""
        charge, scale = np.array(charge_pC, dtype=float), self.domain.scale
        slope, shift = self.plane[:-1] * scale, self.plane[-1] * scale + self.domain.centre
        residual = self._residual_in_units

        def compute() -> Array:
            features = self.features(charge)
            rows = self.tree.query(features, self.k)[1]
            contact: Array = np.add.reduce(residual[rows]) + features @ slope + shift
            contact[2] = np.exp(contact[2])
            return contact

        return compute

    @cached_property
    def _residual_in_units(self) -> Array:
        residual: Array = self.residual * self.domain.scale / self.k
        return residual


@dataclass(frozen=True)
class SklearnNeighbours(Fitted):
    """LinearRegression's plane and KNeighborsRegressor on its residuals."""

    features: LogFeatures
    linear: LinearRegression
    model: KNeighborsRegressor
    domain: ContactDomain
    choice: str
    name: str = NAME
    form: str = "scikit-learn"

    @classmethod
    def of(cls, direct: TreeNeighbours) -> "SklearnNeighbours":
        """With the same presses and metric."""
        features = np.asarray(direct.tree.data)
        unit = with_one(features) @ direct.plane + direct.residual
        linear = LinearRegression().fit(features, unit)
        model = KNeighborsRegressor(direct.k, algorithm="kd_tree").fit(features, unit - linear.predict(features))
        return cls(direct.features, linear, model, direct.domain, direct.choice)

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        features = self.features(charge_pC)
        return self.domain.to_contact(self.linear.predict(features) + self.model.predict(features))
