"""k-nearest neighbours: the mean contact of the noisy presses whose features lie nearest.

With enough noisy copies the mean over neighbours tends to the posterior mean, the best there is. The direct form asks
SciPy's KD-tree without scikit-learn's checks.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from sklearn.neighbors import KNeighborsRegressor

from isocharge.simulate.arrays import Array
from isocharge.train.charge_field import Domain
from isocharge.train.rivals.estimator import Fitted, Task, best_of
from isocharge.train.rivals.features import LogFeatures

NAME = "k-nearest neighbours"


@dataclass(frozen=True)
class NearestNeighbours:
    """The method.

    Attributes:
        counts: Candidates for k.
    """

    counts: tuple[int, ...] = (8, 16, 32, 64)
    name: str = NAME

    def fit(self, task: Task) -> tuple[Fitted, ...]:
        """Choose k, and give both forms."""
        noisy = task.noisy_train(1 if task.quick else task.copies)
        features, unit = LogFeatures.fit(noisy.charge_pC), task.domain.to_unit(noisy.contact)
        tree = cKDTree(features(noisy.charge_pC))
        made = {k: TreeNeighbours(features, tree, unit, k, task.domain) for k in self.counts}
        k, words = best_of(task, self.counts[1:2] if task.quick else self.counts, lambda k: made[k].predict)
        choice = f"k = {k} of {len(unit)} noisy presses{words}"
        direct = replace(made[k], choice=choice)
        regressor = KNeighborsRegressor(k, algorithm="kd_tree").fit(tree.data, unit)
        return SklearnNeighbours(features, regressor, task.domain, choice), direct


@dataclass(frozen=True)
class SklearnNeighbours(Fitted):
    """KNeighborsRegressor."""

    features: LogFeatures
    model: KNeighborsRegressor
    domain: Domain
    choice: str
    name: str = NAME
    form: str = "scikit-learn"

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        return self.domain.to_contact(self.model.predict(self.features(charge_pC)))


@dataclass(frozen=True)
class TreeNeighbours(Fitted):
    """SciPy's KD-tree and a mean.

    Attributes:
        features: Of the charges.
        tree: Features of the presses, shape (n, n_electrode).
        unit: Their contacts in unit coordinates, shape (n, 3).
        k: How many count.
        domain: What the unit coordinates refer to.
    """

    features: LogFeatures
    tree: cKDTree
    unit: Array
    k: int
    domain: Domain
    choice: str = ""
    name: str = NAME
    form: str = "SciPy KD-tree"

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        _, rows = self.tree.query(self.features(charge_pC), self.k)
        return self.domain.to_contact(self.unit[rows].reshape(len(charge_pC), self.k, 3).mean(axis=1))

    def one(self, charge_pC: Array) -> Callable[[], object]:
        """See `Fitted.one`."""
        charge, count = np.array(charge_pC, dtype=float), float(self.k)
        centre, scale = self.domain.centre, self.domain.scale / count

        def compute() -> Array:
            _, rows = self.tree.query(self.features(charge), self.k)
            contact: Array = np.add.reduce(self.unit[rows]) * scale + centre
            contact[2] = np.exp(contact[2])
            return contact

        return compute
