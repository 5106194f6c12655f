"""Fig. 1 to 5 and 7 of the paper: the principle, the mapping schemes, the layout and the mesh."""

from dataclasses import replace
from typing import Any

import numpy as np
from axes import draw_probe, finish_axes, new_axes
from choices import ELEMENTS
from mapping import Mapping
from matplotlib.collections import LineCollection
from page import Entry, Row
from solves import FINEST, FORCE, MESHES, Solves

from isocharge.common.arrays import Array
from isocharge.simulate import Equilibrium, Sensor
from isocharge.simulate.forward import readout
from isocharge.simulate.numerics.disk import contacts_at
from isocharge.simulate.numerics.interpolation import tensor_values
from isocharge.simulate.plots.figure import COLOURS, FELT, INK, PRESSED
from isocharge.simulate.plots.film import draw_electrodes, draw_working_area, frame_film

FIG_4_DEG = (35.0, 145.0)
"""First and last angle of the lines from A: the half that Fig. 6 shows, and its mirror image."""

TOUCHED = 1e-3
"""Smallest share of the probe that counts as lying on an electrode. Smaller shares are rounding errors of areas."""


def fig_1(solves: Solves) -> Entry:
    """Return the entry of Fig. 1: three distances determine a position."""
    sensor = solves.choices.sensor("three")
    at = np.array(solves.choices.shown)
    centres = np.array([e.centre for e in sensor.electrodes])
    distance = np.linalg.norm(centres - at, axis=1)
    meeting = trilaterate(centres, distance)
    along = (centres[1] - centres[0]) / np.linalg.norm(centres[1] - centres[0])
    second = 2.0 * (centres[0] + along * ((at - centres[0]) @ along)) - at
    figure, axes = new_axes(6.4, 6.0)
    angle = np.linspace(0.0, 2.0 * np.pi, 200)
    for name, centre, r, colour in zip("abc", centres, distance, COLOURS, strict=False):
        axes.plot(*centre, "s", color=colour)
        axes.annotate(name, centre, xytext=(6, 6), textcoords="offset points", color=colour)
        circle = centre[:, None] + r * np.array([np.cos(angle), np.sin(angle)])
        axes.plot(*circle, color=colour, lw=1.0, label=f"{r:.2f} mm from {name}")
    axes.plot(*meeting, "o", color=INK, label="all three meet")
    axes.plot(*second, "x", color=INK, label="a and b meet again")
    axes.set(aspect="equal", xlabel="x, mm", ylabel="y, mm", title="Fig. 1: position from three distances")
    axes.legend(fontsize=8)
    error = float(np.linalg.norm(meeting - at))
    again = f"twice, {float(np.linalg.norm(second - at)):.2f} mm apart"
    return Entry(
        "Fig. 1",
        "Three distances from three known points give a position (eq. 1); two give two.",
        figure,
        [
            Row("three circles", "one point", f"one point, {error:.1g} mm from the press", "round-off"),
            Row("two circles", "two intersections", again, "the mirror image in the line through their centres"),
        ],
        {"error_mm": error},
    )


def trilaterate(centres: Array, distance: Array) -> Array:
    """Solve eq. 1, the equations of three circles. The difference of two of these equations is linear in the position.

    Args:
        centres: Centres (x, y) of the circles, shape (3, 2), mm.
        distance: Radii of the circles, shape (3,), mm.

    Returns:
        Position (x, y), shape (2,), mm.
    """
    matrix = 2.0 * (centres[1:] - centres[0])
    squared_norm = np.sum(centres**2, axis=1)
    right_side = distance[0] ** 2 - distance[1:] ** 2 + squared_norm[1:] - squared_norm[0]
    return np.linalg.lstsq(matrix, right_side, rcond=None)[0]


def fig_2(solves: Solves) -> Entry:
    """Return the entry of Fig. 2: the mapping scheme about one electrode."""
    sensor = solves.choices.sensor("three")
    mapping = Mapping.lines(sensor, "A", solves.choices.length, (0.0, 350.0))
    figure, axes = new_axes(6.4, 6.2)
    draw_mapping(axes, mapping)
    draw_electrodes(axes, sensor, highlight="A")
    axes.set(aspect="equal", xlabel="x, mm", ylabel="y, mm", title="Fig. 2: mapping scheme")
    figure.legend(fontsize=8, loc="outside lower center", ncols=2)
    step = float(np.diff(mapping.distance)[0])
    angle_step = float(np.rad2deg(np.diff(mapping.angle)[0]))
    length = f"{mapping.distance[-1]:g} mm"
    return Entry(
        "Fig. 2",
        "Lines and circles about the centre of an electrode; a press at each intersection.",
        figure,
        [
            Row("radial and angular increments", "4 mm, 10°", f"{step:g} mm, {angle_step:g}°", "as given"),
            Row("length of the lines", "not given", length, "our choice: across the working area from any electrode"),
        ],
    )


def fig_3(solves: Solves) -> Entry:
    """Return the entry of Fig. 3: the layout with three electrodes, and the layout that the text describes."""
    sensor = solves.choices.sensor("three")
    printed = solves.choices.as_printed()
    figure, (left, right) = new_axes(11.0, 5.6, columns=2)
    for axes, shown, title in ((left, sensor, "Fig. 3: layout, equilateral"), (right, printed, "as the text has it")):
        draw_electrodes(axes, shown)
        draw_working_area(axes, shown.film.radius, "clamped rim")
        corners = np.array([e.centre for e in (*shown.electrodes, shown.electrodes[0])])
        axes.plot(*corners.T, color=FELT, lw=0.8, label="between the centres")
        axes.set(xlim=(-47, 47), ylim=(-47, 47), aspect="equal", xlabel="x (drawn), mm", ylabel="y, mm", title=title)
    left.legend(fontsize=8, loc="lower left")
    sides, equal, directions = _triangle(sensor)
    printed_sides, unequal, _ = _triangle(printed)
    why = "60° and 120° are the directions from A to B and C; from the centre they give no equilateral triangle"
    return Entry(
        "Fig. 3",
        "Three electrodes of 3 mm, 10 mm from the centre of a film clamped at 45 mm.",
        figure,
        [
            Row("sides of the triangle", "equal", equal, "by construction"),
            Row("angles to B and C", "60° and 120° from the centre", f"{directions} from A", why),
            Row("sides, with 60° and 120° from the centre", "equal", unequal, "the sentence contradicts it"),
        ],
        {"sides_mm": sides, "sides_as_printed_mm": printed_sides},
    )


def _triangle(sensor: Sensor) -> tuple[list[float], str, str]:
    """Return the sides AB, BC and CA of the triangle of the centres.

    Returns:
        The sides in mm, the sides as a text, and the directions from A to B and C as a text.
    """
    a, b, c = (complex(*e.centre) for e in sensor.electrodes)
    sides = [abs(b - a), abs(c - b), abs(a - c)]
    directions = ", ".join(f"{np.rad2deg(np.angle(z - a)):.0f}°" for z in (b, c))
    return sides, ", ".join(f"{side:.2f}" for side in sides) + " mm", directions


def scheme(solves: Solves, heading: str, electrode: str, degrees: tuple[float, float]) -> Entry:
    """Return the entry of Fig. 4 or 7: the lines from an electrode between two angles.

    Args:
        solves: Results of the solves.
        heading: Heading of the entry.
        electrode: Name of the electrode.
        degrees: First and last angle of the lines, degrees.
    """
    sensor = solves.choices.sensor("three")
    mapping = Mapping.lines(sensor, electrode, solves.choices.length, degrees)
    figure, axes = new_axes(6.8, 6.8)
    draw_mapping(axes, mapping)
    draw_electrodes(axes, sensor, highlight=electrode)
    draw_working_area(axes, solves.choices.radius, f"working area, {solves.choices.radius:g} mm")
    draw_probe(axes, solves.choices.triangle, (float(mapping.points[3, 1, 0]), float(mapping.points[3, 1, 1])), "probe")
    frame_film(axes, sensor, mapping.radius, f"{heading}: lines from {electrode}")
    figure.legend(fontsize=8, loc="outside lower center", ncols=4)
    over = contact_charges(solves, sensor, mapping.points.reshape(-1, 2), -2.0 / FORCE) > TOUCHED
    overlap = dict(zip(sensor.electrode_names, over.sum(axis=0).tolist(), strict=True))
    overlaps = f"{over.any(axis=1).sum()} of {len(over)} presses: " + ", ".join(
        f"{n} on {e}" for e, n in overlap.items()
    )
    return Entry(
        heading,
        f"Lines from electrode {electrode} at {degrees[0]:g}° to {degrees[1]:g}° from the drawn direction.",
        figure,
        [Row("probe over an electrode", "a small overlap with B in some", overlaps, "triangle of 4 mm, our choice")],
        {"presses_over_an_electrode": overlap},
    )


def contact_charges(solves: Solves, sensor: Sensor, points: Array, d33: float) -> Array:
    """Compute the charges of the contact pressure of a triangle.

    Args:
        solves: Results of the solves.
        sensor: The sensor.
        points: Positions (x, y) of the presses, shape (n, 2), mm.
        d33: Coefficient d33, pC/N.

    Returns:
        Charges, shape (n, n_electrode), pC.
    """
    sensor_with_d33 = replace(sensor, piezo=replace(sensor.piezo, d33=d33))
    return readout.contact_charges(sensor_with_d33, solves.choices.triangle, contacts_at(points, FORCE))


def fig_5(solves: Solves) -> Entry:
    """Return the entry of Fig. 5: the mesh, and the error as a function of its fineness."""
    (*charges, finest), (*unknowns, _), (*seconds, _) = zip(*solves.meshes, strict=True)
    error = np.abs(np.array(charges) / finest - 1.0).max(axis=1)
    figure, (whole, near, errors) = new_axes(15.0, 5.0, columns=3)
    for axes, (x, y), reach, title in (
        (whole, (0.0, 0.0), 46.0, "Fig. 5: mesh, whole film"),
        (near, solves.shown.at, 8.0, "at the probe"),
    ):
        _draw_mesh(axes, solves.shown)
        draw_electrodes(axes, solves.choices.sensor("three"), names=axes is near, ink="#2e6f9e")
        axes.set(
            xlim=(x - reach, x + reach),
            ylim=(y - reach, y + reach),
            xlabel="x, mm",
            ylabel="y, mm",
            aspect="equal",
            title=title,
        )
    errors.loglog(unknowns, 100.0 * error, "o-", color=FELT, label="ours, the shown press")
    errors.axhline(0.1, color=INK, lw=0.8, ls=":", label="0.1 %")
    errors.set_xticks(unknowns, [f"{n:,}" for n in unknowns])
    errors.minorticks_off()
    finish_axes(errors, "unknowns", "worst charge against the finest mesh, %", "error against mesh")
    enough = int(np.argmax(error < 1e-3))
    mesh = solves.shown.mesh
    rows = [
        Row(
            "elements",
            f"{ELEMENTS[0]:,} to {ELEMENTS[1]:,} triangles",
            f"{mesh.template.nodes.shape[0]} quadrilaterals of order {mesh.resolution.order}, "
            f"{3 * mesh.template.n_node} unknowns",
            "high order on a mesh that follows the probe; the solution is smooth outside of it",
        ),
        Row(
            "fine enough?",
            "captures the entire geometry well enough",
            f"0.1 % of a charge takes {unknowns[enough]:,} unknowns and {seconds[enough]:.2f} s",
            "simulate/docs/accuracy.md shows speed against error. 13,000 quadratic triangles of dolfinx give 0.08 % in "
            "13 s, and 13,000 linear ones of CalculiX 3 %: too many for a good element, and not enough for one like "
            "SHELL63",
        ),
    ]
    return Entry(
        "Fig. 5",
        "Elements under a triangular probe: the whole film, at the probe, and the error against the unknowns.",
        figure,
        rows,
        {
            "unknowns": unknowns,
            "worst_relative_error": error.tolist(),
            "cpu_s": seconds,
            "meshes_order_around_rings_rim": [*MESHES],
            "finest": FINEST,
        },
    )


def _draw_mesh(axes: Any, shown: Equilibrium) -> None:
    """Draw the edges of the elements and the probe."""
    along = np.linspace(-1.0, 1.0, 13)
    one = np.ones(13)
    xi = np.concatenate([along, one, -along, -one])
    eta = np.concatenate([-one, along, one, -along])
    turned = shown.film.radius * np.exp(1j * np.angle(complex(*shown.at)))
    z = shown.mesh.points @ tensor_values(shown.mesh.resolution.order, xi, eta).T * turned
    axes.add_collection(LineCollection(list(np.stack([z.real, z.imag], axis=-1)), colors=INK, linewidths=0.5))
    draw_probe(axes, shown.probe, shown.at)


def draw_mapping(axes: Any, mapping: Mapping) -> None:
    """Draw the lines and circles of a mapping scheme, and its presses."""
    points = np.concatenate([np.broadcast_to(mapping.origin, (mapping.angle.size, 1, 2)), mapping.points], axis=1)
    for angle, line in zip(mapping.angle, points, strict=True):
        axes.plot(*line.T, color=PRESSED, lw=0.8)
        axes.annotate(
            f"{np.rad2deg(angle):.0f}°", line[-1], fontsize=7, color=INK, ha="center", va="center",
            xytext=(9 * np.cos(angle), 9 * np.sin(angle)), textcoords="offset points",
        )  # fmt: skip
    for number, distance in enumerate(mapping.distance):
        arc = np.linspace(mapping.angle[0], mapping.angle[-1], 90)
        circle = mapping.origin + distance * np.stack([np.cos(arc), np.sin(arc)], axis=1)
        axes.plot(*circle.T, color=PRESSED, lw=0.6, ls="--", label="circles, every step" if number == 0 else None)
    axes.plot(*points[:, 1:].reshape(-1, 2).T, ".", color=FELT, ms=4, label="presses")
