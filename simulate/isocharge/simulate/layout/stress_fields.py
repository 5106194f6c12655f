"""Charges of electrodes anywhere on the film, and derivatives of the charges with respect to the press parameters.

A forward map interpolates the stress and its derivatives with respect to the position and the force of the press, the
probe radius and the pretension. All presses have the same probe and the same force. The equilibrium of the film under a
press does not depend on the electrodes, so the same stress fields are used for all layouts.
"""

import math
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.common.contact_domain import Domain
from isocharge.simulate.forward.family import NodeCount
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.forward.readout import ChargeDensity, ElectrodePieces
from isocharge.simulate.mechanics.theory import rotate_stress
from isocharge.simulate.numerics.polygon import to_complex, to_corners
from isocharge.simulate.sensor.film import Surface
from isocharge.simulate.sensor.footprint import Probe
from isocharge.simulate.sensor.probe import Circle
from isocharge.simulate.sensor.sensor import Electrode, Sensor
from isocharge.simulate.solver.equilibrium import Equilibrium, nodal_stress, touch_stress
from isocharge.simulate.solver.load_case import SolveSettings
from isocharge.simulate.solver.press import press
from isocharge.simulate.solver.sensitivity import change_by_node_shift

COLUMNS = ("charge", "x", "y", "ln force", "probe radius", "pretension")
"""Names of the results for one press and one electrode, in the order of the last axis of an array.

The columns are the charge (pC) and its derivatives with respect to x and y (pC/mm), ln F (pC), the probe radius (pC/mm)
and the pretension (pC/MPa).
"""

COLUMN_IS_ODD = np.array([column == "y" for column in COLUMNS])
"""Whether each column changes its sign if the film is mirrored about the direction of the press, shape (6,)."""

STEPS = (0.02, 0.02, 0.05, 0.02, 0.1)
"""Steps of the finite differences of the stress, in the order of the derivatives in `COLUMNS`.

The steps of the position and of the probe radius are in units of the probe radius. The step of the pretension is in
MPa.
"""

NODE_COUNT = NodeCount(distances=8, forces=1)
"""Numbers of distances and forces of the solved presses."""

PRESS_CHUNK = 256
"""Number of presses that are evaluated at once, which limits the required memory to about 100 MB."""


def solve_fields(
    sensor: Sensor, probe: Probe, force: float, radius: float, executor: Executor | None = None
) -> ForwardMap:
    """Solve presses at a few distances from the centre, and compute one stress field for each of the `COLUMNS`.

    Args:
        sensor: Sensor with the film, its piezoelectric coefficients and the surface at which the stress is read.
        probe: Circular probe that presses the film.
        force: Force of the presses, N.
        radius: Largest distance of a press from the centre, mm.
        executor: Executor that runs the solves; None to run the solves in this process.

    Returns:
        Forward map with a table of the scaled stress and its derivatives in single precision.

    Raises:
        SolveError: If a press has no equilibrium.
    """
    domain = Domain(radius, (force, force))
    fields = ForwardMap.build_unchecked(
        sensor, probe, domain, NODE_COUNT, read=_stress_and_derivatives, executor=executor
    )
    return replace(fields, table=fields.table.astype(np.float32))


def charges_and_derivatives(fields: ForwardMap, presses: Array, electrodes: Sequence[Electrode]) -> Array:
    """Compute the charges of electrodes under presses, and the derivatives of these charges.

    The charge per area is averaged over the area of an electrode, even if the sensor has the edge readout.

    Args:
        fields: Stress fields that `solve_fields` returns.
        presses: Positions (x, y) of the presses, shape (n, 2), mm.
        electrodes: Electrodes of any shape at their nominal positions.

    Returns:
        Charge of each electrode under each press, followed by its derivatives, shape (n, n_electrode, 6). The last axis
        has the order of `COLUMNS`.
    """
    chunks = np.array_split(presses, math.ceil(len(presses) / PRESS_CHUNK))
    return np.concatenate([electrode_charges(charge_density(fields, chunk), electrodes) for chunk in chunks])


def charge_density(fields: ForwardMap, presses: Array) -> ChargeDensity:
    """Interpolate the stress fields at the positions of presses, and convert the stress to charge per area.

    There are six stress fields: the stress itself, and its derivatives with respect to x, y, ln F, the probe radius and
    the pretension. The array `COLUMN_IS_ODD` states which fields change their sign if the film is mirrored about the
    direction of the press.

    Args:
        fields: Forward map that `solve_fields` returns. The map interpolates the stress fields, and its domain must
            contain the presses.
        presses: Positions (x, y) of the presses, shape (n, 2), mm.

    Returns:
        Charge per area and its derivatives, with one field for each of the `COLUMNS`.
    """
    position = to_complex(presses)
    force = np.full(len(presses), fields.family.force[0])  # the map was solved for a single force
    orientation = np.zeros(len(presses))  # the probe is circular
    charge_per_stress = fields.sensor.piezo.charge_per_stress[None]  # the same for all electrodes, shape (1, 3)
    return fields.charge_density(position, force, orientation, COLUMN_IS_ODD, charge_per_stress)


def electrode_charges(density: ChargeDensity, electrodes: Sequence[Electrode]) -> Array:
    """Compute the charges of electrodes, and their derivatives with respect to the parameters of the presses.

    Args:
        density: Charge per area under the presses, with one field for each of the `COLUMNS`.
        electrodes: Electrodes of any shape at their nominal positions.

    Returns:
        Charge of each electrode under each press, followed by its derivatives, shape (n_press, n_electrode, 6). The
        last axis has the order of `COLUMNS`.
    """
    if not electrodes:
        return np.empty((density.position.size, 0, len(COLUMNS)))
    charges = density.integrate(ElectrodePieces.covering(electrodes))  # with the derivatives, in the order of `COLUMNS`

    # In the frame of the press, the columns x and y contain the derivatives along and across the direction of the
    # press. Rotate these two components of the gradient, as complex numbers, into the axes of the film.
    x_column = COLUMNS.index("x")
    y_column = COLUMNS.index("y")
    along_and_across = charges[..., x_column] + 1j * charges[..., y_column]
    direction = np.exp(1j * np.angle(density.position))[:, None]
    gradient = along_and_across * direction
    charges[..., x_column] = gradient.real
    charges[..., y_column] = gradient.imag
    return charges


def _stress_and_derivatives(solved: Equilibrium, surface: Surface) -> Array:
    """Compute the stress at the mesh nodes for one press, and its derivatives with respect to five parameters.

    The parameters are x, y, ln F, the probe radius and the pretension. For each of them, the solver solves the press
    again with a slightly larger and a slightly smaller value, and the stresses are subtracted. The mesh moves with the
    press, but the derivatives refer to fixed points of the film.

    Args:
        solved: Equilibrium of the film under a press on the positive x axis.
        surface: Surface at which the stress is read: the middle, the top or the bottom of the film.

    Returns:
        Stress (s11, s22, s12) in the axes of the film, followed by its five derivatives, divided by the unit of the
        scaled stress, shape (n_element, n_local, 6, 3).
    """
    stress = _stress_in_film_axes(solved, surface)
    distance, _ = solved.at  # the position of the press is (distance, 0), mm
    radius = solved.probe.reach
    # Steps of x, y, ln F, probe radius and pretension. The steps of the three lengths are in units of the probe radius.
    steps = np.multiply(STEPS, [radius, radius, 1.0, radius, 1.0])
    fields = [stress]
    for parameter, step, changes in zip(COLUMNS[1:], steps, np.diag(steps), strict=True):
        increased = _changed_press(solved, changes)  # only the change of this parameter is not zero
        if parameter == "pretension":  # a one-sided difference, because the pretension may be zero
            fields.append((_stress_in_film_axes(increased, surface) - stress) / step)
            continue

        # The mesh turns with the direction from the centre to the press. Near the centre, the angle is large: half a
        # turn if a step in x crosses the centre, and more than 0.1 rad for a step in y if the distance is less than ten
        # steps. Steps of the other parameters do not turn the mesh.
        decreased = _changed_press(solved, -changes)
        min_steps_from_centre = {"x": 1.0, "y": 10.0}.get(parameter, 0.0)
        if distance < min_steps_from_centre * step:
            # Both stresses are interpolated at the nodes of the original mesh.
            change = _change_at_fixed_points(solved, decreased, increased, surface)
        else:
            # The nodes move a little with the press. Subtract the change of the stress that their movement causes.
            node_shift = _nodes_in_film_axes(increased) - _nodes_in_film_axes(decreased)
            change_at_nodes = _stress_in_film_axes(increased, surface) - _stress_in_film_axes(decreased, surface)
            change = change_at_nodes - change_by_node_shift(solved.mesh, stress, node_shift)
        fields.append(change / (2.0 * step))
    stress_unit = solved.film.young * solved.groups.squared_amplitude
    return np.stack(fields, axis=2) / stress_unit


def _changed_press(solved: Equilibrium, changes: Array) -> Equilibrium:
    """Solve a press that differs slightly from a press that is already solved.

    Args:
        solved: Equilibrium of the film under a press on the positive x axis, from which the solver starts.
        changes: Changes of x and y (mm), ln F, the probe radius (mm) and the pretension (MPa), shape (5,).
    """
    x, y, log_force, probe_radius, pretension = changes.tolist()
    film = solved.film
    distance, _ = solved.at
    return press(
        replace(film, pretension=film.pretension + pretension),
        Circle(solved.probe.reach + probe_radius),
        (distance + x, y),
        solved.force * math.exp(log_force),
        SolveSettings(theory=solved.theory, resolution=solved.mesh.resolution, layer=solved.mesh.layer),
        start=solved,
    )


def _stress_in_film_axes(solved: Equilibrium, surface: Surface) -> Array:
    """Return the stress at the nodes in the axes of the film, shape (n_element, n_local, 3), MPa."""
    stress_unit = solved.film.young * solved.groups.squared_amplitude
    return stress_unit * rotate_stress(nodal_stress(solved, surface), solved.direction)


def _nodes_in_film_axes(solved: Equilibrium) -> Complexes:
    """Return the positions x + iy of the nodes in the axes of the film, shape (n_element, n_local), film radii."""
    return np.asarray(solved.mesh.points * np.exp(1j * solved.direction))


def _change_at_fixed_points(solved: Equilibrium, first: Equilibrium, second: Equilibrium, surface: Surface) -> Array:
    """Compute how much the stress differs between two presses, at the mesh nodes of a third press.

    Args:
        solved: Third press, at whose nodes both stresses are read.
        first: First press, whose stress is subtracted from the stress under the second press.
        second: Second press.
        surface: Surface at which the stress is read.

    Returns:
        Stress (s11, s22, s12) under the second press minus stress under the first press, shape (n_element, n_local, 3),
        MPa.
    """
    points = solved.film.radius * (1.0 - 1e-12) * solved.mesh.points  # on the film despite rounding errors
    corners = to_corners(points.ravel())
    difference = touch_stress(second, corners, surface) - touch_stress(first, corners, surface)
    return difference.reshape(*points.shape, 3)
