"""First-order change of an equilibrium by what a film has that is not isotropic and round.

With the equilibrium's residual R(u, m) = 0 and the tangent K = dR/du, an imperfection m moves the film by

    du/dm = -K^-1 dR/dm,

one more back substitution. Seen from the press, an imperfection with two axes at an angle alpha to the direction of the
press is cos(2 alpha) of one that is even about this direction and sin(2 alpha) of one that is odd. Both are solved on
the half of the film that is meshed: even and odd fields differ in what the line of symmetry fixes. dR/dm and the stress
that follows are central differences of the very residual and stress that a press is solved with.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate.execution.blas import single_threaded_blas
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.scaling import Anisotropy
from isocharge.simulate.mechanics.stress import stress_rotation
from isocharge.simulate.sensor.film import Surface
from isocharge.simulate.solver.assembly import assembly
from isocharge.simulate.solver.equilibrium import Equilibrium, nodal_stress

STEP = 1e-3
"""Step of the differences by an imperfection, in its unit: strains of order one are quadratic in it or nearly so."""

Change = Callable[[Equilibrium, float], Equilibrium]
"""An equilibrium's film with some of an imperfection, its field as it was."""


@dataclass(frozen=True)
class StressField:
    """One field of stress changes.

    Attributes:
        change: The imperfection.
        odd: Whether it is odd about the direction of the press.
    """

    change: Change
    odd: bool


def _tension(direction: tuple[float, float, float]) -> Change:
    """Pretension over E A^2 (1 + mean pretension over E A^2)."""

    def change(solved: Equilibrium, share: float) -> Equilibrium:
        tension = share * (1.0 + solved.groups.tension) * np.array(direction)
        return replace(solved, groups=replace(solved.groups, anisotropy=Anisotropy(np.zeros((3, 3)), tension)))

    return change


def _stiffness(angle: float) -> Change:
    """ln(E1 / E2), axis 1 at an angle."""

    def change(solved: Equilibrium, share: float) -> Equilibrium:
        turn, plane = stress_rotation(angle), 1.0 / (1.0 - solved.groups.poisson**2)
        moduli = turn @ np.diag([0.5 * share * plane, -0.5 * share * plane, 0.0]) @ turn.T
        return replace(solved, groups=replace(solved.groups, anisotropy=Anisotropy(moduli, np.zeros(3))))

    return change


def _poisson(solved: Equilibrium, share: float) -> Equilibrium:
    before, after = solved.groups.poisson, solved.groups.poisson + share
    bending = solved.groups.bending * (1.0 - before**2) / (1.0 - after**2)
    return replace(solved, groups=replace(solved.groups, poisson=after, bending=bending))


def _oval(direction: complex) -> Change:
    def change(solved: Equilibrium, share: float) -> Equilibrium:
        return replace(solved, mesh=replace(solved.mesh, oval=share * direction))

    return change


FIELDS = {
    "tension": (StressField(_tension((1.0, -1.0, 0.0)), False), StressField(_tension((0.0, 0.0, 1.0)), True)),
    "stiffness": (StressField(_stiffness(0.0), False), StressField(_stiffness(0.25 * np.pi), True)),
    "poisson": (StressField(_poisson, False),),
    "oval": (StressField(_oval(1.0), False), StressField(_oval(1j), True)),
}
"""Imperfections by name; of those with two axes the even field and the odd one."""

IS_ODD = np.array([field.odd for fields in FIELDS.values() for field in fields])
"""Which fields are odd, in the order of `stress_changes`."""


def stress_changes(solved: Equilibrium, surface: Surface = "middle") -> Array:
    """Change of the scaled stress at the nodes by each field of `FIELDS`, the press rotated onto the x axis.

    Args:
        solved: A press with a round probe on an isotropic round film, by a theory with stretching.
        surface: Where in the thickness; see `touch_stress`.

    Returns:
        Shape (n_field, n_element, n_local, 3), as `nodal_stress`, per unit of the imperfection: at points of the film,
        not of the mesh where that moves along with an oval rim.
    """
    with single_threaded_blas():
        components = 3 if solved.groups.bending == 0.0 else 4
        tangent = ElasticFilm(solved.mesh.geometry, solved.groups).tangent(solved.field)
        factors = [assembly(solved.mesh.template, components, odd).factor(tangent) for odd in (False, True)]
        fields = [field for fields in FIELDS.values() for field in fields]
        return np.stack([_one(solved, field, factors[field.odd].solve, surface) for field in fields])


def _one(solved: Equilibrium, field: StressField, solve: Callable[[Array], Array], surface: Surface) -> Array:
    ends = [field.change(solved, sign * STEP) for sign in (1.0, -1.0)]
    forces = [ElasticFilm(end.mesh.geometry, end.groups).residual(end.field) for end in ends]
    moved = -0.5 * solve(forces[0] - forces[1])  # by one step
    more, less = (
        nodal_stress(replace(end, field=end.field + sign * moved), surface)
        for end, sign in zip(ends, (1.0, -1.0), strict=True)
    )
    change = (more - less) / (2.0 * STEP)
    if ends[0].mesh.oval != 0.0:
        shift = (ends[0].mesh.points - ends[1].mesh.points) / (2.0 * STEP)
        slope = solved.mesh.node_derivatives(nodal_stress(solved, surface))
        change -= shift.real[..., None] * slope[..., 0, :] + shift.imag[..., None] * slope[..., 1, :]
    return np.asarray(change)
