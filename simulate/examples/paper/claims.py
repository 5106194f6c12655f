"""Claims of the paper that belong to no figure, and the influence of our choices."""

from dataclasses import replace

import numpy as np
from choices import LINEAR_MPA
from figure_layouts import TOUCHED, contact_charges
from mapping import Mapping
from page import Entry, Row
from solves import FORCE, Solves
from triangulation_errors import Accuracy

from isocharge.simulate import press
from isocharge.simulate.forward.readout import thermal_charge
from isocharge.simulate.solver.equilibrium import principal_stress

D33 = -30.0
PYRO = -30.0
MAX_FORCE_N = 2.0
"""Largest force of the paper, N."""

KELVIN = 0.1
"""d33 (pC/N) and pyroelectric coefficient (pC/(mm^2 K)) of PVDF with d31 > 0, and the temperature step (K) that a
finger causes."""


def claims(solves: Solves, accuracy: Accuracy) -> Entry:
    """Return the entry with the claims of the text that belong to no figure."""
    edges, of_edges = _edges(solves)
    pressure, of_pressure = _d33(solves)
    sensor = solves.choices.sensor("three")
    shown = solves.shown
    pressed_harder = press(shown.film, shown.probe, shown.at, MAX_FORCE_N)
    largest = principal_stress(pressed_harder)[1]
    warm = thermal_charge(replace(sensor, piezo=replace(sensor.piezo, pyro=PYRO)), KELVIN)[0]
    pyro = Row(
        "pyroelectric charge",
        "can dominate; not considered",
        f"{warm:.0f} pC on each electrode for {KELVIN:g} K",
        f"{PYRO:g} uC/(m^2 K) on {sensor.electrodes[0].area:g} mm^2; it is equal on all electrodes, unlike a press",
    )
    linear = Row(
        "the material stays linear",
        f"up to {LINEAR_MPA:g} MPa",
        f"{largest:.0f} MPa beside the triangle at {MAX_FORCE_N:g} N",
        "beyond its range beside the probe" if largest > LINEAR_MPA else "within its range",
    )
    numbers = {
        "edge_against_area_percent": of_edges,
        "d33_pC": of_pressure,
        "pyro_pC_per_0.1_K": warm,
        "largest_stress_MPa": largest,
        "from_the_field_with_reference_noise": {name: e.numbers() for name, e in accuracy.noisy.items()},
        "drawn_with_reference_noise": {name: e.numbers() for name, e in accuracy.drawn_noisy.items()},
    }
    rows = [edges, pressure, pyro, linear, _fourth(accuracy, solves.choices.degree), _known(accuracy)]
    return Entry("Claims", "Statements of the text, compared with computed values.", None, rows, numbers)


def _edges(solves: Solves) -> tuple[Row, dict[str, object]]:
    """Compare the charges by edge averages with those of the whole electrodes."""
    edge, area = (
        solves.charges("triangle", solves.choices.sensor("three", readout=readout), solves.places)
        for readout in ("edge", "area")
    )
    change = 100.0 * np.abs(edge / area - 1.0)
    middle = np.median(change)
    most = np.percentile(change, 95)
    worst = change.max()
    row = Row(
        "edge averages (eq. 3) give the charge",
        "\"precise\"",
        f"the difference from the charge of the whole electrode within {solves.choices.radius:g} mm has a median of "
        f"{middle:.2f} %, a 95th percentile of {most:.1f} % and a maximum of {worst:.1f} %",
        "an electrode collects charge from all of its area; the mean over its edges does not contain the stress beside "
        "the probe",
    )  # fmt: skip
    return row, {"median": middle, "p95": most, "worst": worst}


def _d33(solves: Solves) -> tuple[Row, dict[str, object]]:
    """Compute the charges of the contact pressure where the probe covers a part of an electrode."""
    sensor = solves.choices.sensor("three")
    whole = -0.5 * D33 * FORCE
    points = Mapping.lines(sensor, "A", solves.choices.length).points.reshape(-1, 2)
    extra = contact_charges(solves, sensor, points, D33)
    share = extra / solves.charges("triangle", sensor, points)
    row = Row(
        "d33 where the probe overlaps an electrode",
        "no charge",
        f"up to {extra.max():.1f} pC, and up to {100 * share.max():.1f} % of the charge of a press "
        f"({(extra > TOUCHED * whole).any(axis=1).sum()} of {len(points)} presses have such a charge); "
        f"{whole:.0f} pC if the whole force acts on the electrode",
        f"a thin film also carries the pressure of the probe; d33 = {D33:g} pC/N. The charge is small compared with "
        "that of the stretching, so it can be omitted, but not for the stated reason",
    )
    return row, {"largest": extra.max(), "largest_share": share.max()}


def _fourth(accuracy: Accuracy, degree: int) -> Row:
    """Compare the position errors of three and four electrodes."""
    changes = []
    for name, three, four in (
        ("contours of the paper, no noise", accuracy.drawn["three", degree], accuracy.drawn["four", degree]),
        ("contours of the charge map, no noise", accuracy.field["three"], accuracy.field["four"]),
        ("contours of the paper, noise", accuracy.drawn_noisy["three"], accuracy.drawn_noisy["four"]),
        ("contours of the charge map, noise", accuracy.noisy["three"], accuracy.noisy["four"]),
    ):
        medians, most = ([e.percentile(share) for e in (three, four)] for share in (50, 95))
        changes.append(
            f"{name}: {medians[0]:.2g} to {medians[1]:.2g} mm at the median, {most[0]:.2g} to {most[1]:.2g} mm at "
            f"95 %, {100 * three.share_found:.0f} to {100 * four.share_found:.0f} % found"
        )
    return Row(
        "effect of a fourth electrode",
        "a more accurate position",
        "; ".join(changes),
        "the noise is 1 pC and 0.2 % of each charge. The mean over triples of electrodes improves the position little, "
        "because contours of opposite electrodes are nearly parallel near the centre. With a fourth charge, more "
        "presses are found",
    )


def _known(accuracy: Accuracy) -> Row:
    """Return the position errors if a wrong probe or film is assumed."""
    errors_by_name = [
        f"{name}: {errors.percentile(50):.2f} mm, {100 * errors.share_found:.0f} % found"
        for name, errors in accuracy.mistaken.items()
        if name.startswith(("probe", "pretension"))
    ]
    return Row(
        "shape and size of the object must be known",
        "must be known",
        "median errors if a triangle of 4 mm on a film without pretension is assumed: " + "; ".join(errors_by_name),
        "the force is known; a small pretension causes larger errors than another probe",
    )


def what_choices_change(solves: Solves, accuracy: Accuracy) -> Entry:
    """Return the entry with the changes of the charges by values that the paper does not state."""
    rows = []
    numbers = {}
    film = solves.choices.sensor("three").film
    piezo = solves.choices.sensor("three").piezo
    ours = {
        "E": f"{film.young * 1e-3:g} GPa",
        "nu": f"{film.poisson:g}",
        "probe": f"{solves.choices.triangle.notation} (side, mm)",
        "pretension": "0 MPa",
    }
    for name, errors in accuracy.mistaken.items():
        kind, _, value = name.partition(" ")
        changes = solves.changes(name)
        position = f"{errors.percentile(50):.3f} mm" if errors.found_mm.size else "not found, because no contours meet"
        change = (
            f"the charges change by {100 * np.median(changes):+.1f} % at the median and by at most "
            f"{100 * np.abs(changes).max():.1f} %; position error if this value is not known: {position}"
        )
        rows.append(Row(f"{kind}: {value}", "not given", change, f"chosen here: {ours[kind]}"))
        numbers[name] = {"largest_change": np.abs(changes).max()}
    linear = f"the charges are linear in both; chosen here for a biaxial film: {piezo.d31:g} and {piezo.d32:g} pC/N"
    d31_of_eq_4 = piezo.d31 / solves.eq_4[1]
    agreement = f"eq. 4 agrees with d31 = {d31_of_eq_4:.1f} pC/N if all other values are those chosen here"
    rows.append(Row("d31, d32", "not given", linear, agreement))
    caption = "Values that are chosen here, and the effect of other values."
    return Entry("What the paper does not give", caption, None, rows, numbers)
