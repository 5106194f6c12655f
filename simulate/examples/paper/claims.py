"""The paper's other claims, and what our choices change."""

from dataclasses import replace

import numpy as np
from choices import PAPER
from entry import Entry, Row
from figure_layouts import TOUCHED
from solves import FORCE, Solves, sample
from triangulation_errors import Accuracy, Errors, largest_change

from isocharge.common.arrays import Array
from isocharge.simulate.contours.charge_curves import Mapping
from isocharge.simulate.forward.readout import contact_charge, thermal_charge
from isocharge.simulate.solver.equilibrium import principal_stress

D33, PYRO, KELVIN = -30.0, 30.0, 0.1
"""d33 (pC/N) and pyroelectric coefficient (pC/(mm^2 K)) of PVDF, and a step (K) that a finger makes easily."""


def claims(solves: Solves, accuracy: Accuracy) -> Entry:
    """What the text says without a figure."""
    rows, numbers = [], {}
    for make in (_edges, _d33, _pyro, _stress):
        row, values = make(solves)
        rows.append(row)
        numbers.update(values)
    rows += [_fourth(accuracy, solves.choices.degree), _known(accuracy)]
    numbers["from_the_field_with_reference_noise"] = {name: e.numbers() for name, e in accuracy.noisy.items()}
    numbers["drawn_with_reference_noise"] = {name: e.numbers() for name, e in accuracy.drawn_noisy.items()}
    return Entry("Claims", "What the text says, in numbers.", None, rows, numbers)


def _edges(solves: Solves) -> tuple[Row, dict[str, object]]:
    """Edge averages against the whole electrode."""
    places = solves.places
    edge, area = (
        solves.charges("triangle", solves.choices.sensor("three", readout=readout), places)
        for readout in ("edge", "area")
    )
    change = 100.0 * np.abs(edge / area - 1.0)
    middle, most, worst = np.median(change), np.percentile(change, 95), change.max()
    row = Row(
        "edge averages (eq. 3) give the charge",
        "\"precise\"",
        f"off the whole electrode's charge by {middle:.2f} % at the median, {most:.1f} % at 95 %, {worst:.1f} % most, "
        f"within {solves.choices.radius:g} mm",
        "an electrode collects from all of its area; edges are a quadrature that misses the stress beside the probe",
    )  # fmt: skip
    return row, {"edge_against_area_percent": {"median": middle, "p95": most, "worst": worst}}


def _d33(solves: Solves) -> tuple[Row, dict[str, object]]:
    """The contact pressure where the probe covers part of B."""
    sensor = solves.choices.sensor("three")
    taking = replace(sensor, piezo=replace(sensor.piezo, d33=D33))
    points = Mapping.lines(sensor, "A", length=solves.choices.length).points.reshape(-1, 2)
    extra = np.array([contact_charge(taking, solves.choices.triangle, (x, y), FORCE) for x, y in points])
    charge = solves.charges("triangle", sensor, points)
    share = extra / charge
    over = extra > TOUCHED * -D33 * FORCE
    whole = -D33 * FORCE
    row = Row(
        "d33 where the probe overlaps an electrode",
        "no charge",
        f"up to {extra.max():.1f} pC, {100 * share.max():.1f} % of the charge there "
        f"({over.any(axis=1).sum()} of {len(points)} presses of the scheme); "
        f"{whole:.0f} pC if the electrode carried all of the force",
        f"a thin film does carry the probe's pressure; d33 = {D33:g} pC/N. Small beside the stretching: leaving "
        "it out is right, the reason given is not",
    )
    return row, {"d33_pC": {"largest": extra.max(), "largest_share": share.max()}}


def _pyro(solves: Solves) -> tuple[Row, dict[str, object]]:
    sensor = solves.choices.sensor("three")
    warm = thermal_charge(replace(sensor, piezo=replace(sensor.piezo, pyro=PYRO)), KELVIN)[0]
    row = Row(
        "pyroelectric charge",
        "can dominate; left out",
        f"{warm:.0f} pC on each electrode for {KELVIN:g} K",
        f"{PYRO:g} uC/(m^2 K) on {sensor.electrodes[0].area:g} mm^2; the same on all, a press is not",
    )
    return row, {"pyro_pC_per_0.1_K": warm}


def _stress(solves: Solves) -> tuple[Row, dict[str, object]]:
    largest = principal_stress(solves.shown)[1]
    row = Row(
        "the material stays linear",
        f"up to {PAPER.linear_MPa:g} MPa",
        f"{largest:.0f} MPa beside the triangle at 1 N",
        "beyond its range beside the probe" if largest > PAPER.linear_MPa else "within its range",
    )
    return row, {"largest_stress_MPa": largest}


def _both(name: str, three: Errors, four: Errors) -> str:
    """What a fourth electrode changes."""
    medians, most = ([e.percentile(share) for e in (three, four)] for share in (50, 95))
    return (
        f"{name}: {medians[0]:.2g} to {medians[1]:.2g} mm at the median, {most[0]:.2g} to {most[1]:.2g} mm at 95 %, "
        f"{100 * three.share_found:.0f} to {100 * four.share_found:.0f} % found"
    )


def _fourth(accuracy: Accuracy, degree: int) -> Row:
    ours = "; ".join(
        [
            _both("as the paper, no noise", accuracy.drawn["three", degree], accuracy.drawn["four", degree]),
            _both("from the field, no noise", accuracy.field["three"], accuracy.field["four"]),
            _both("as the paper, noise", accuracy.drawn_noisy["three"], accuracy.drawn_noisy["four"]),
            _both("from the field, noise", accuracy.noisy["three"], accuracy.noisy["four"]),
        ]
    )
    why = (
        "noise is 1 pC and 0.2 % of each charge. Averaging triples helps less than it could: contours of opposite "
        "electrodes touch near the centre, and their crossing is poor there; a fourth charge finds more presses"
    )
    return Row("a fourth electrode, three to four", "a more accurate position", ours, why)


def _known(accuracy: Accuracy) -> Row:
    """The probe and the film must be known."""
    errors_by_name = [
        f"{name}: {errors.percentile(50):.2f} mm, {100 * errors.share_found:.0f} % found"
        for name, errors in accuracy.mistaken.items()
        if name.startswith(("probe", "pretension"))
    ]
    return Row(
        "shape and size of the object must be known",
        "must be known",
        "taken for a triangle of 4 mm on a slack film, median error: " + "; ".join(errors_by_name),
        "known force; a film that is a little taut costs more than the wrong probe",
    )


def what_choices_change(solves: Solves, accuracy: Accuracy) -> Entry:
    """Sizes that the paper does not give."""
    rows = []
    film, piezo = solves.choices.sensor("three").film, solves.choices.sensor("three").piezo
    ours = {
        "E": f"{film.young * 1e-3:g} GPa",
        "nu": f"{film.poisson:g}",
        "probe": f"{solves.choices.triangle.notation} (side, mm)",
        "pretension": "0 MPa",
    }
    for name in solves.variants:
        kind, _, value = name.partition(" ")
        errors = accuracy.mistaken[name]
        position = f"{errors.percentile(50):.3f} mm" if errors.found_mm.size else "no contours met"
        change = f"charges by {_signed(solves, name)}, at most {100 * largest_change(solves, name):.1f} %"
        rows.append(
            Row(
                f"{kind}: {value}",
                "not given",
                f"{change}; position if not known: {position}",
                f"our choice {ours[kind]}",
            )
        )
    rows.append(
        Row(
            "d31, d32",
            "not given",
            f"charges are linear in them; biaxial {piezo.d31:g} and {piezo.d32:g} pC/N",
            f"eq. 4 agrees with d31 = {piezo.d31 / solves.eq_4[1]:.1f} pC/N, all else as ours",
        )
    )
    numbers = {name: {"largest_change": largest_change(solves, name)} for name in solves.variants}
    return Entry("What the paper does not give", "Our choices, and what others would change.", None, rows, numbers)


def _signed(solves: Solves, name: str) -> str:
    """Median relative change of a charge, with its sign."""
    at: Array = np.array(sample(solves.choices))
    charge = solves.charges("triangle", solves.choices.sensor("three"), at)
    return f"{100 * float(np.median(solves.variants[name][0] / charge - 1.0)):+.1f} % at the median"
