"""Gradient boosting: scikit-learn's histogram trees, one ensemble per coordinate, learnt from noisy copies, on what an
affine fit leaves.

The plain form is the same trees as one node of an ONNX graph. Converting them by skl2onnx 1.20 fails with protobuf 7.34
and later (it writes booleans where integers are due), so the node is written here.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import onnxruntime as ort
from onnx import TensorProto, helper, numpy_helper
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.multioutput import MultiOutputRegressor

from isocharge.common.arrays import Array
from isocharge.serve.model.session import open_session
from isocharge.train.baselines.estimator import Fitted, FittingTask, best_of
from isocharge.train.baselines.features import LogFeatures, affine_fit, with_one
from isocharge.train.data.domain import ContactDomain
from isocharge.train.release.export import IR_VERSION, OPSET

NAME = "gradient boosting"

TREE_DOMAIN, TREE_OPSET = "ai.onnx.ml", 3
"""ONNX's operators for trees, and their first version with thresholds in float64."""


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
        values, candidates = features(noisy.charge_pC), {}
        plane = affine_fit(values, unit)
        residual = unit - with_one(values) @ plane

        def predict_with(leaves: int) -> Callable[[Array], Array]:
            model = self._regressor(leaves, task).fit(values, residual)
            candidates[leaves] = SklearnBoosting(features, plane, model, task.domain)
            return candidates[leaves].predict

        leaves, comparison = best_of(task, self.leaves[:1] if task.quick else self.leaves, predict_with)
        count = candidates[leaves].model.estimators_[0].n_iter_
        size = f"{count} trees of {leaves} leaves per coordinate, rate {self.rate:g}"
        library = replace(candidates[leaves], choice=f"{size}, {len(unit)} noisy presses{comparison}")
        return library, OnnxBoosting.of(library)

    def _regressor(self, leaves: int, task: FittingTask) -> MultiOutputRegressor:
        return MultiOutputRegressor(
            HistGradientBoostingRegressor(
                max_iter=30 if task.quick else self.trees,
                learning_rate=self.rate,
                max_leaf_nodes=leaves,
                early_stopping=False,
                random_state=task.seed,
            )
        )


@dataclass(frozen=True)
class SklearnBoosting(Fitted):
    """An affine map and HistGradientBoostingRegressors for x, y and ln F."""

    features: LogFeatures
    plane: Array
    model: MultiOutputRegressor
    domain: ContactDomain
    choice: str = ""
    name: str = NAME
    form: str = "scikit-learn"

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        values = self.features(charge_pC)
        return self.domain.to_contact(with_one(values) @ self.plane + self.model.predict(values))


@dataclass(frozen=True)
class OnnxBoosting(Fitted):
    """The same trees in ONNX Runtime: thresholds in float64, sums in float32. Features and affine map stay in NumPy.

    Attributes:
        features: Of the charges.
        plane: The affine map, shape (n_electrode + 1, 3).
        graph: See `tree_graph`.
        domain: What the unit coordinates refer to.
    """

    features: LogFeatures
    plane: Array
    graph: bytes
    domain: ContactDomain
    choice: str = ""
    name: str = NAME
    form: str = "ONNX Runtime"

    @classmethod
    def of(cls, library: SklearnBoosting) -> "OnnxBoosting":
        """From the scikit-learn form."""
        graph = tree_graph(library.model.estimators_)
        return cls(library.features, library.plane, graph, library.domain, library.choice)

    @cached_property
    def _session(self) -> ort.InferenceSession:
        return open_session(self.graph, self.name)

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        values = self.features(charge_pC)
        boosted = self._session.run(None, {"features": values})[0]
        return self.domain.to_contact(with_one(values) @ self.plane + boosted)


def tree_graph(models: Sequence[HistGradientBoostingRegressor]) -> bytes:
    """An ONNX graph with the input `features` [n, n_feature], float64, and the output `sums` [n, n_model], float32.

    Reads the trees as scikit-learn keeps them (`_predictors` and `_baseline_prediction`, tried with 1.9): it has no
    public access to them.
    """
    trees = [stage[0].nodes for model in models for stage in model._predictors]
    sizes, nodes = [len(tree) for tree in trees], np.concatenate(trees)
    tree, number = np.repeat(np.arange(len(trees)), sizes), np.concatenate([np.arange(size) for size in sizes])
    target = np.repeat(np.arange(len(models)), [len(model._predictors) for model in models])[tree]
    leaf = nodes["is_leaf"].astype(bool)
    start = np.array([model._baseline_prediction[0, 0] for model in models])
    node = helper.make_node(
        "TreeEnsembleRegressor",
        ["features"],
        ["sums"],
        domain=TREE_DOMAIN,
        n_targets=len(models),
        base_values_as_tensor=numpy_helper.from_array(start),
        nodes_treeids=tree.tolist(),
        nodes_nodeids=number.tolist(),
        nodes_modes=np.where(leaf, "LEAF", "BRANCH_LEQ").tolist(),
        nodes_featureids=np.where(leaf, 0, nodes["feature_idx"]).tolist(),
        nodes_values_as_tensor=numpy_helper.from_array(np.where(leaf, 0.0, nodes["num_threshold"])),
        nodes_truenodeids=np.where(leaf, 0, nodes["left"]).tolist(),
        nodes_falsenodeids=np.where(leaf, 0, nodes["right"]).tolist(),
        target_treeids=tree[leaf].tolist(),
        target_nodeids=number[leaf].tolist(),
        target_ids=target[leaf].tolist(),
        target_weights_as_tensor=numpy_helper.from_array(nodes["value"][leaf].astype(float)),
    )
    features, sums = (
        helper.make_tensor_value_info(name, kind, ["n", width])
        for name, kind, width in (
            ("features", TensorProto.DOUBLE, models[0].n_features_in_),
            ("sums", TensorProto.FLOAT, len(models)),
        )
    )
    graph = helper.make_graph([node], "trees", [features], [sums])
    opsets = [helper.make_opsetid("", OPSET), helper.make_opsetid(TREE_DOMAIN, TREE_OPSET)]
    return bytes(helper.make_model(graph, opset_imports=opsets, ir_version=IR_VERSION).SerializeToString())
