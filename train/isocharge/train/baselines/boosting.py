"""Gradient boosting: scikit-learn's histogram trees, one ensemble per coordinate, learnt from noisy copies, on what an
affine fit leaves.

The NumPy form walks all trees of all coordinates at once, one level per step.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor

from isocharge.arrays import Array, Integers
from isocharge.train.baselines.estimator import Fitted, FittingTask, best_of
from isocharge.train.baselines.features import LogFeatures, affine_fit, with_one
from isocharge.train.data.domain import ContactDomain

NAME = "gradient boosting"

BATCH = 64
"""Presses that walk the trees at once: their nodes stay in the cache."""


@dataclass(frozen=True)
class GradientBoosting:
    """The method.

    Attributes:
        leaves: Candidates for the leaves of a tree.
        trees: Trees per coordinate.
        rate: Learning rate.
    """

    leaves: tuple[int, ...] = (31, 63)
    trees: int = 250
    rate: float = 0.1
    name: str = NAME

    def fit(self, task: FittingTask) -> tuple[Fitted, ...]:
        """Choose the leaves, and give both forms."""
        noisy = task.noisy_train(1 if task.quick else min(task.copies, 3))
        features, unit = LogFeatures.fit(noisy.charge_pC), task.domain.to_unit(noisy.contact)
        values, made = features(noisy.charge_pC), {}
        plane = affine_fit(values, unit)
        residual = unit - with_one(values) @ plane

        def predict_with(leaves: int) -> Callable[[Array], Array]:
            models = self._models(values, residual, leaves, task)
            made[leaves] = SklearnBoosting(features, plane, models, task.domain)
            return made[leaves].predict

        leaves, words = best_of(task, self.leaves[:1] if task.quick else self.leaves, predict_with)
        count = made[leaves].models[0].n_iter_
        choice = (
            f"{count} trees of {leaves} leaves per coordinate, rate {self.rate:g}, {len(unit)} noisy presses{words}"
        )
        library = replace(made[leaves], choice=choice)
        return library, NumpyBoosting.of(library)

    def _models(
        self, values: Array, unit: Array, leaves: int, task: FittingTask
    ) -> tuple[HistGradientBoostingRegressor, ...]:
        settings = {
            "max_iter": 30 if task.quick else self.trees,
            "learning_rate": self.rate,
            "max_leaf_nodes": leaves,
            "early_stopping": False,
            "random_state": task.seed,
        }
        return tuple(HistGradientBoostingRegressor(**settings).fit(values, column) for column in unit.T)


@dataclass(frozen=True)
class SklearnBoosting(Fitted):
    """An affine map and three HistGradientBoostingRegressors, for x, y and ln F."""

    features: LogFeatures
    plane: Array
    models: tuple[HistGradientBoostingRegressor, ...]
    domain: ContactDomain
    choice: str = ""
    name: str = NAME
    form: str = "scikit-learn"

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        values = self.features(charge_pC)
        boosted = np.stack([model.predict(values) for model in self.models], axis=1)
        return self.domain.to_contact(with_one(values) @ self.plane + boosted)


@dataclass(frozen=True)
class NumpyBoosting(Fitted):
    """The same trees as arrays.

    Attributes:
        features: Of the charges.
        plane: The affine map, shape (n_electrode + 1, 3); the trees' own start is in it.
        feature: Which one a node looks at, shape (n_node,).
        threshold: Left if the feature is not above it; infinite for a leaf, shape (n_node,).
        children: Left and right node, a leaf's own number for a leaf, shape (n_node, 2).
        value: Of a leaf, shape (n_node,).
        roots: First node of each tree, shape (3, n_tree).
        depth: Steps from a root to its deepest leaf.
    """

    features: LogFeatures
    plane: Array
    feature: Integers
    threshold: Array
    children: Integers
    value: Array
    roots: Integers
    depth: int
    domain: ContactDomain
    choice: str = ""
    name: str = NAME
    form: str = "NumPy"

    @classmethod
    def of(cls, library: SklearnBoosting) -> "NumpyBoosting":
        """From the scikit-learn form; reads its trees as scikit-learn keeps them (`_predictors`, tried with 1.9)."""
        trees = [stage[0].nodes for model in library.models for stage in model._predictors]
        first = np.concatenate([[0], np.cumsum([len(nodes) for nodes in trees])])
        nodes = np.concatenate(trees)
        offset, leaf = np.repeat(first[:-1], np.diff(first)), nodes["is_leaf"].astype(bool)
        own = np.arange(len(nodes))
        start = [float(model._baseline_prediction[0, 0]) for model in library.models]
        children = [np.where(leaf, own, nodes[side].astype(np.intp) + offset) for side in ("left", "right")]
        return cls(
            features=library.features,
            plane=library.plane + np.outer(np.eye(len(library.plane))[-1], start),
            feature=np.where(leaf, 0, nodes["feature_idx"]).astype(np.intp),
            threshold=np.where(leaf, np.inf, nodes["num_threshold"]),
            children=np.stack(children, axis=1),
            value=nodes["value"].astype(float),
            roots=first[:-1].reshape(3, -1),
            depth=int(nodes["depth"].max()),
            domain=library.domain,
            choice=library.choice,
        )

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        values = self.features(charge_pC)
        parts = [self._walk(values[start : start + BATCH]) for start in range(0, len(values), BATCH)]
        return self.domain.to_contact(np.concatenate(parts))

    def _walk(self, values: Array) -> Array:
        """Unit coordinates, shape (n, 3), from features, shape (n, n_electrode)."""
        flat, width = values.ravel(), values.shape[1]
        node = np.tile(self.roots.ravel(), (len(values), 1))
        row = width * np.arange(len(values))[:, None]
        children = self.children.ravel()
        for _ in range(self.depth):
            right = flat.take(self.feature.take(node) + row) > self.threshold.take(node)
            node = children.take(2 * node + right)
        sums = self.value.take(node).reshape(len(values), 3, -1).sum(axis=2)
        unit: Array = sums + with_one(values) @ self.plane
        return unit
