"""Estimates of the errors of a solved press, warnings, and a summary of its results.

In the inner part of the film, the shapes of the elements show whether a mesh is fine enough. The shapes are not a
sufficient criterion for presses near the rim, or for large footprints that are not circular. Under such presses,
elements that are too coarse may lie far from the elements with the largest stress. The shapes are also insufficient for
a pressure on the whole film, because this pressure also bends the large elements far from the probe. The module `press`
therefore solves these presses on meshes of increasing polynomial order, until two successive meshes result in nearly
the same charges. The module solves all other presses in the same way if the required accuracy is better than the
default accuracy. If the polynomial order of the elements increases by one, the error decreases by a factor of three to
ten. The difference between the charges of two successive meshes is therefore an upper bound of the error on the finer
mesh.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_STRESS_LIMIT
from isocharge.common.errors import SolveError
from isocharge.common.structs import plain_values
from isocharge.simulate.mechanics.theory import Theory, directional_stiffness
from isocharge.simulate.solver.equilibrium import Equilibrium, deflection, principal_stress
from isocharge.simulate.solver.load_case import SolveSettings
from isocharge.simulate.solver.press import press

MESH_ERROR_SAFETY = 2.0
"""Safety factor in the estimated error of a mesh, dimensionless.

The estimated error is this factor times the change of the charges that results if the order of the mesh increases by
one.
"""

MIN_MESH_ERROR = 5e-5
"""Smallest relative error of a charge that is reported.

The thin rings and the integration over the electrodes cause an error of this order.
"""

ReadCharges = Callable[[Equilibrium], Array]
"""Function that computes the charges of the electrodes from an equilibrium, shape (n_electrode,)."""


def change_of_charges(equilibrium: Equilibrium, settings: SolveSettings, read_charges: ReadCharges) -> float:
    """Solve a press again with other settings, and compute how much the charges change.

    Args:
        equilibrium: The solved press.
        settings: The other settings.
        read_charges: Function that computes the charges.

    Returns:
        Largest change of a charge, relative to the largest charge; infinite if the press cannot be solved again.
    """
    try:
        other = press(
            equilibrium.film,
            equilibrium.probe,
            equilibrium.at,
            equilibrium.force,
            settings,
            side_force=equilibrium.side_force,
            start=equilibrium,
        )
    except SolveError:
        return np.inf
    other_charges = read_charges(other)
    change = np.abs(read_charges(equilibrium) - other_charges).max()
    return float(change / np.abs(other_charges).max())


def mesh_error(equilibrium: Equilibrium, read_charges: ReadCharges) -> float:
    """Estimate the error that the mesh causes in a charge, relative to the largest charge.

    If the press was solved on two meshes, the estimate is the relative difference between the results on both meshes,
    which is the attribute `proven_error`.
    If the press was solved on one mesh, it is solved again on a mesh of the next higher order.

    Args:
        equilibrium: The solved press.
        read_charges: Function that computes the charges.

    Returns:
        Relative error from `MIN_MESH_ERROR` to 1.
    """
    error = equilibrium.proven_error
    if error is None:
        mesh = equilibrium.mesh
        finer = replace(mesh.resolution, order=mesh.resolution.order + 1)
        settings = SolveSettings(theory=equilibrium.theory, resolution=finer, layer=mesh.layer)
        error = MESH_ERROR_SAFETY * change_of_charges(equilibrium, settings, read_charges)
    return float(np.clip(error, MIN_MESH_ERROR, 1.0))


def modelling_error(equilibrium: Equilibrium, read_charges: ReadCharges) -> float:
    """Estimate the error that the theory of the film causes in a charge, relative to the largest charge.

    Bending changes the stress near the clamp and near the edge of the footprint. The effect on the charges depends on
    the positions and the shapes of the footprint and of the electrodes. Therefore the press is solved a second time.
    The second solution includes bending if the given solution omits bending, and omits bending otherwise. The effect of
    bending is the difference between the charges of both solutions.

    If the given solution omits bending, its error is the effect of bending. The theory with bending averages the
    bending stiffness of an orthotropic film over all directions. The error of this average is the effect of bending
    times the relative standard deviation of the bending stiffness over the directions. In this product, the effect of
    bending is limited to 1.

    Args:
        equilibrium: The solved press.
        read_charges: Function that computes the charges.

    Returns:
        Relative error, which is infinite if the theory cannot describe the film.
    """
    has_bending = equilibrium.theory.bending
    stiffness = directional_stiffness(equilibrium.film)
    if has_bending and np.ptp(stiffness) == 0.0:  # the film is isotropic
        return 0.0
    other_theory = SolveSettings(theory=Theory(bending=not has_bending))
    effect_of_bending = change_of_charges(equilibrium, other_theory, read_charges)
    if has_bending:
        return float(np.std(stiffness) / np.mean(stiffness)) * min(effect_of_bending, 1.0)
    # If bending changes the charges by 100 % or more, a theory without bending does not describe the film.
    return effect_of_bending if effect_of_bending < 1.0 else np.inf


def estimated_error(equilibrium: Equilibrium, read_charges: ReadCharges) -> float:
    """Estimate the error that the mesh and the theory cause in a charge, relative to the largest charge.

    Args:
        equilibrium: The solved press.
        read_charges: Function that computes the charges.

    Returns:
        Relative error, which is infinite if the theory cannot describe the film.
    """
    return mesh_error(equilibrium, read_charges) + modelling_error(equilibrium, read_charges)


WRINKLE_SHARE = 1e-3
"""Ratio of the compression to the largest stress above which a warning is given, dimensionless."""


def cautions(equilibrium: Equilibrium) -> tuple[str, ...]:
    """Return warnings about effects in a real film that the theory does not model.

    Args:
        equilibrium: The solved press.

    Returns:
        One sentence for each warning.
    """
    smallest, largest = principal_stress(equilibrium)  # MPa, negative in compression
    sentences = []
    if largest > DEFAULT_STRESS_LIMIT:
        sentences.append(f"the film is stressed to {largest:.3g} MPa; PVDF yields from {DEFAULT_STRESS_LIMIT:g} MPa on")
    if smallest < -WRINKLE_SHARE * largest:
        sentences.append(f"the film is compressed to {smallest:.3g} MPa somewhere; a thin film may wrinkle there")
    # The pretension in the direction of its smallest value. `deviator` is its uneven part: (T11 - T22) / 2 and T12.
    smallest_tension = equilibrium.film.pretension - np.hypot(*equilibrium.film.deviator)
    if smallest_tension < 0.0:
        sentences.append(
            f"without a press, the film is compressed to {smallest_tension:.3g} MPa; if it wrinkles then, the measured "
            "charges are smaller, because touch charges are computed relative to the flat film"
        )
    return tuple(sentences)


def summary(equilibrium: Equilibrium, read_charges: ReadCharges) -> dict[str, Any]:
    """Return the results of a solved press as a dictionary for JSON output.

    The dictionary contains the deflection, the theory, the estimated error, the outcome of the solve and the warnings.
    The estimated error of a charge is relative to the largest charge.

    Args:
        equilibrium: The solved press.
        read_charges: Function that computes the charges.
    """
    (centre_deflection,) = deflection(equilibrium, np.array([equilibrium.at]))
    return {
        "deflection_mm": float(centre_deflection),
        "theory": equilibrium.theory.name,
        "status": equilibrium.status,
        "iterations": equilibrium.iterations,
        "residual": equilibrium.residual,
        "seconds": equilibrium.seconds,
        "estimated_error": plain_values(estimated_error(equilibrium, read_charges)),
        "warnings": list(cautions(equilibrium)),
    }
