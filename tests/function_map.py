"""Charge maps whose charges are computed by a function."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.simulate import Domain
from isocharge.simulate.forward.charge_map import differences


@dataclass(frozen=True)
class FunctionMap:
    """Charge map of a function of contacts, shape (n, 3), that returns charges, shape (n, n_electrode), pC.

    The derivatives are central differences, so the function must also accept contacts slightly outside the domain.
    """

    function: Any
    electrodes: tuple[str, ...]
    domain: Domain

    def charges(self, contact):
        return self.function(contact)

    def derivatives(self, contact):
        return differences(self.function, contact)


def round_map(centres, domain):
    """Return a map whose charges depend on the force and on the distance from each electrode, shape (n_electrode, 2).

    All contours of a charge are therefore circles.
    """

    def charges(contact):
        distance = np.linalg.norm(contact[:, None, :2] - centres, axis=2)
        return 1e3 * contact[:, 2:] ** (2.0 / 3.0) / (1.0 + (distance / 12.0) ** 2)

    return FunctionMap(charges, tuple("ABCD"[: len(centres)]), domain)
