"""Charge map whose charges are computed by a function."""

from dataclasses import dataclass
from typing import Any

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
