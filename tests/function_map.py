"""Charge maps whose charges are computed by a function."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.simulate import Domain
from isocharge.simulate.forward.charge_map import STEPS, differences


@dataclass(frozen=True)
class FunctionMap:
    """Charge map of a function of contacts, shape (n, 3), that returns charges, shape (n, n_electrode), pC.

    The derivatives are central differences, so the function must also accept contacts slightly outside the domain.
    """

    function: Any
    electrodes: tuple[str, ...]
    domain: Domain
    steps: tuple[float, float, float] = STEPS

    def charges(self, contact):
        return self.function(contact)

    def linearised(self, contact):
        return self.function(contact), differences(self.function, contact, self.steps)


def round_map(centres, domain):
    """Return a map whose charges depend on the force and on the distance from each electrode, shape (n_electrode, 2).

    All contours of a charge are therefore circles.
    """

    def charges(contact):
        distance = np.linalg.norm(contact[:, None, :2] - centres, axis=2)
        return 1e3 * contact[:, 2:] ** (2.0 / 3.0) / (1.0 + (distance / 12.0) ** 2)

    return FunctionMap(charges, tuple("ABCD"[: len(centres)]), domain)


FOLD_X = 3.0
"""Position x of the fold line of folded maps, mm: x and 2 FOLD_X - x give the same charges."""


def shaped_charges(*shapes, radius: float = 5.0, forces: tuple[float, float] = (0.05, 2.0)) -> FunctionMap:
    """Return a map of charges that are functions of x and y, and of one charge that depends only on the force.

    The steps of the differences are small, because the charges may vary within about 0.1 mm.
    """

    def charge(contact):
        x, y, force = contact.T
        columns = [3.0 + 0.3 * shape(x, y) for shape in shapes]
        return 300.0 * force[:, None] ** (2.0 / 3.0) * np.stack([*columns, np.full(len(x), 3.0)], axis=1)

    return FunctionMap(charge, tuple("ABCDE"[: len(shapes) + 1]), Domain(radius, forces), (1e-3, 1e-3, 1e-3))


def folded_map(*shapes, **domain) -> FunctionMap:
    """Return a map of three charges that fold at x = FOLD_X, and further charges that are functions of x and y."""
    return shaped_charges(lambda x, _: x - x**2 / (2.0 * FOLD_X), lambda _, y: y, *shapes, **domain)
