"""Polynomial ridge regression: all monomials of the features up to a degree, least squares on noisy copies.

Its scikit-learn form spends its time on checks; the NumPy form is the same polynomial. For one press it is summed
variable by variable, coefficients of shape (degree + 1, ...) times the powers of one feature, and again; for many, each
monomial is the product of one of lower degree and a feature. (As a graph by skl2onnx, in float32 only, 495 terms take
404 us for one press instead of 18, and are a seventh as fast in batches.)
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations_with_replacement
from math import comb

import numpy as np
from sklearn.linear_model import Ridge
from sklearn.pipeline import Pipeline, make_pipeline
from sklearn.preprocessing import PolynomialFeatures

from isocharge.common.arrays import Array, Integers
from isocharge.train.baselines.estimator import Fitted, FittingTask, best_of
from isocharge.train.baselines.features import LogFeatures
from isocharge.train.data.domain import ContactDomain

NAME = "polynomial ridge"

MOST_TERMS = 500
"""Monomials at most; more bring nothing under noise and cost time."""

BATCH = 1024
"""Presses whose monomials are computed at once, so that they stay in the cache."""


@dataclass(frozen=True)
class PolynomialRidge:
    """The method.

    Attributes:
        degrees: Candidates.
        alphas: Candidates for the ridge, relative to the number of rows.
    """

    degrees: tuple[int, ...] = (4, 6, 8, 10, 12)
    alphas: tuple[float, ...] = (1e-11, 1e-8)
    name: str = NAME

    def fit(self, task: FittingTask) -> tuple[Fitted, ...]:
        """Choose degree and ridge, and give both forms."""
        noisy = task.noisy_train(1 if task.quick else task.copies)
        features, unit = LogFeatures.into_box(noisy.charge_pC), task.domain.to_unit(noisy.contact)
        boxed, n_electrode = box(features, noisy.charge_pC), noisy.charge_pC.shape[1]
        candidates = [(degree, alpha) for degree in self._degrees(n_electrode) for alpha in self.alphas]

        def fitted(candidate: tuple[int, float]) -> SklearnPolynomial:
            degree, alpha = candidate
            ridge = Ridge(alpha=alpha * len(boxed), solver="cholesky")
            model = make_pipeline(PolynomialFeatures(degree), ridge).fit(boxed, unit)
            return SklearnPolynomial(features, model, task.domain)

        models = {candidate: fitted(candidate) for candidate in (candidates[:1] if task.quick else candidates)}
        best, comparison = best_of(task, models, lambda candidate: models[candidate].predict)
        terms = comb(n_electrode + best[0], n_electrode)
        choice = (
            f"degree {best[0]} ({terms} terms), ridge {best[1]:g} of the rows, {len(unit)} noisy presses{comparison}"
        )
        library = replace(models[best], choice=choice)
        return library, NumpyPolynomial.of(library)

    def _degrees(self, n_electrode: int) -> list[int]:
        """The two highest candidates whose monomials are not too many; where all have too many, the highest below."""
        degrees = range(1, max(self.degrees) + 1)
        small = [degree for degree in degrees if comb(n_electrode + degree, degree) <= MOST_TERMS]
        return [degree for degree in self.degrees if degree in small][-2:] or small[-1:]


def box(features: LogFeatures, charge_pC: Array) -> Array:
    """Features held within [-1, 1]: a high degree explodes outside of what it has seen."""
    values: Array = np.minimum(np.maximum(features(charge_pC), -1.0), 1.0)
    return values


@dataclass(frozen=True)
class SklearnPolynomial(Fitted):
    """PolynomialFeatures and Ridge in a pipeline."""

    features: LogFeatures
    model: Pipeline
    domain: ContactDomain
    choice: str = ""
    name: str = NAME
    form: str = "scikit-learn"

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        return self.domain.to_contact(self.model.predict(box(self.features, charge_pC)))


@dataclass(frozen=True)
class NumpyPolynomial(Fitted):
    """The same polynomial, in NumPy.

    Attributes:
        features: Of the charges.
        weights: Of the monomials in scikit-learn's order, shape (n_term, 3); units and scales are in them.
        degree: Highest degree.
    """

    features: LogFeatures
    weights: Array
    degree: int
    choice: str = ""
    name: str = NAME
    form: str = "NumPy"

    @classmethod
    def of(cls, library: SklearnPolynomial) -> "NumpyPolynomial":
        """From the scikit-learn form."""
        terms, ridge = library.model[0], library.model[-1]
        weights = ridge.coef_.T.copy()
        weights[0] += ridge.intercept_
        weights = weights * library.domain.scale
        weights[0] += library.domain.centre
        return cls(library.features, weights, terms.degree, library.choice)

    def predict(self, charge_pC: Array) -> Array:
        """See `Fitted.predict`."""
        parts = [self._contacts(charge_pC[start : start + BATCH]) for start in range(0, len(charge_pC), BATCH)]
        contact = np.concatenate(parts)
        contact[:, 2] = np.exp(contact[:, 2])
        return contact

    def _contacts(self, charge_pC: Array) -> Array:
        values = np.ascontiguousarray(box(self.features, charge_pC).T)
        terms = np.ones((len(self.weights), values.shape[1]))
        for number, parent, factor in self._recipe:
            np.multiply(terms[parent], values[factor], out=terms[number])
        contact: Array = terms.T @ self.weights
        return contact

    def one(self, charge_pC: Array) -> Callable[[], object]:
        """See `Fitted.one`."""
        charge = np.array(charge_pC, dtype=float)
        return lambda: self.single(charge)

    def single(self, charge_pC: Array) -> Array:
        """The contact of one press, shape (n_electrode,) to (3,)."""
        sums, orders = self._dense, self._orders
        for powers in box(self.features, charge_pC)[::-1, None] ** orders:
            sums = sums.reshape(-1, orders.size) @ powers
        sums[2] = np.exp(sums[2])
        return sums

    @cached_property
    def _orders(self) -> Array:
        return np.arange(self.degree + 1.0)

    @cached_property
    def _dense(self) -> Array:
        """Weights by the power of each feature, shape (3, degree + 1, ...)."""
        variables = self.features.shift.size
        dense = np.zeros((3, *(self.degree + 1,) * variables))
        dense[:, *monomials(variables, self.degree).T] = self.weights.T
        return dense

    @cached_property
    def _recipe(self) -> list[tuple[int, int, int]]:
        return lower_monomials(self.features.shift.size, self.degree)


def monomials(variables: int, degree: int) -> Integers:
    """Powers of each variable in each monomial, in scikit-learn's order, shape (n_term, variables)."""
    powers: Integers = PolynomialFeatures(degree).fit(np.zeros((1, variables))).powers_
    return powers


def lower_monomials(variables: int, degree: int) -> list[tuple[int, int, int]]:
    """How each monomial but the first comes from one before it: its number, that one's, and the feature to multiply."""
    terms = [term for d in range(degree + 1) for term in combinations_with_replacement(range(variables), d)]
    number = {term: k for k, term in enumerate(terms)}
    return [(k, number[term[:-1]], term[-1]) for term, k in number.items() if term]
