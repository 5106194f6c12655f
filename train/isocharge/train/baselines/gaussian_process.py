"""Gaussian process regression on a subset of the presses, one kernel for all coordinates.

Its cost grows with the presses it keeps, so it keeps few. The NumPy form is the posterior mean alone: one row of kernel
values times fixed weights. (As a graph by skl2onnx it takes 54 us for one press instead of 13, and is a fifth as fast
in batches; in float32 it is wrong by millimetres.)
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from warnings import catch_warnings, simplefilter

import numpy as np
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, Kernel, WhiteKernel

from isocharge.common.arrays import Array
from isocharge.train.baselines.estimator import Fitted, FittingTask
from isocharge.train.baselines.features import LogFeatures
from isocharge.train.data.domain import ContactDomain

NAME = "Gaussian process"

BATCH = 256
"""Presses whose kernel rows are computed at once."""


@dataclass(frozen=True)
class GaussianProcess:
    """The method.

    Attributes:
        points: Noisy presses that it keeps.
        learnt_from: Presses that choose the kernel's lengths, by marginal likelihood.
    """

    points: int = 2000
    learnt_from: int = 500
    name: str = NAME

    def fit(self, task: FittingTask) -> tuple[Fitted, ...]:
        """Lengths by marginal likelihood on a small subset, weights on a larger one; both forms."""
        noisy = task.noisy_train(1)
        rows = np.random.default_rng(task.seed).permutation(len(noisy))[: 300 if task.quick else self.points]
        features, unit = LogFeatures.fit(noisy.charge_pC), task.domain.to_unit(noisy.contact[rows])
        values = features(noisy.charge_pC[rows])
        few = 150 if task.quick else self.learnt_from
        kernel = _learnt_kernel(values[:few], unit[:few], task.seed)
        model = GaussianProcessRegressor(kernel, optimizer=None, normalize_y=True, random_state=task.seed)
        choice = f"{len(rows)} noisy presses, {_kernel_text(kernel)}; lengths by marginal likelihood on {few} of them"
        library = SklearnProcess(features, model.fit(values, unit), task.domain, choice)
        return library, NumpyProcess.of(library)


def _learnt_kernel(values: Array, unit: Array, seed: int) -> Kernel:
    start = ConstantKernel(10.0, (1e-2, 1e5)) * RBF(np.full(values.shape[1], 2.0), (0.1, 100.0)) + WhiteKernel(
        1e-3, (1e-8, 1.0)
    )
    with catch_warnings():
        simplefilter("ignore", ConvergenceWarning)  # a length at its bound is an answer, too
        return GaussianProcessRegressor(start, normalize_y=True, random_state=seed).fit(values, unit).kernel_


def _kernel_text(kernel: Kernel) -> str:
    lengths = ", ".join(f"{length:.2g}" for length in np.atleast_1d(kernel.k1.k2.length_scale))
    return f"RBF lengths {lengths}, white {kernel.k2.noise_level:.2g}"


@dataclass(frozen=True)
class SklearnProcess(Fitted):
    """GaussianProcessRegressor."""

    features: LogFeatures
    model: GaussianProcessRegressor
    domain: ContactDomain
    choice: str = ""
    name: str = NAME
    form: str = "scikit-learn"

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        values = self.features(charge_pC)
        parts = [self.model.predict(values[start : start + BATCH]) for start in range(0, len(values), BATCH)]
        return self.domain.to_contact(np.concatenate(parts))


@dataclass(frozen=True)
class NumpyProcess(Fitted):
    """exp(points' . f + offset - |f|^2 / 2) @ weights, with f the features in units of the kernel's lengths.

    Attributes:
        features: Of the charges, in units of the lengths.
        points: Of the presses, shape (n_electrode, m).
        offset: -|point|^2 / 2 + ln(variance), shape (m,).
        weights: Shape (m, 3); units and scales are in them.
        start: Contact where the kernel vanishes (x_mm, y_mm, ln F), shape (3,).
    """

    features: LogFeatures
    points: Array
    offset: Array
    weights: Array
    start: Array
    choice: str = ""
    name: str = NAME
    form: str = "NumPy"

    @classmethod
    def of(cls, library: SklearnProcess) -> "NumpyProcess":
        """From the scikit-learn form."""
        model, domain = library.model, library.domain
        product = model.kernel_.k1
        points = model.X_train_ / product.k2.length_scale
        features = replace(
            library.features,
            matrix=library.features.matrix / product.k2.length_scale,
            shift=library.features.shift / product.k2.length_scale,
        )
        return cls(
            features,
            np.ascontiguousarray(points.T),
            np.log(product.k1.constant_value) - 0.5 * (points**2).sum(axis=1),
            model.alpha_ * model._y_train_std * domain.scale,
            model._y_train_mean * domain.scale + domain.centre,
            library.choice,
        )

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        parts = [self._contacts(charge_pC[start : start + BATCH]) for start in range(0, len(charge_pC), BATCH)]
        return np.concatenate(parts)

    def _contacts(self, charge_pC: Array) -> Array:
        values = self.features(charge_pC)
        kernel = values @ self.points
        kernel += self.offset
        kernel -= 0.5 * (values**2).sum(axis=-1, keepdims=True)
        contact: Array = np.exp(kernel, out=kernel) @ self.weights + self.start
        contact[..., 2] = np.exp(contact[..., 2])
        return contact

    def one(self, charge_pC: Array) -> Callable[[], object]:
        """See `Fitted.one`."""
        charge = np.array(charge_pC, dtype=float)
        return lambda: self._contacts(charge)
