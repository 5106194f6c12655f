"""Charges and deflections compared with independent solvers.

`film_cases.json`: axisymmetric collocation (1e-8) and dolfinx P3 (about 1e-4), errors below 3e-4.
`film_cases_skfem.json`: scikit-fem P3 (3e-5), with off-centre polygons, ellipses, fingers, presses near the rim and
thick films.
"""

import json
import re
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
import pytest

from isocharge.simulate import (
    Equilibrium,
    Film,
    Probe,
    Sensor,
    deflection,
    load_sensor,
    parse_probe,
    press,
    touch_charge,
)
from isocharge.simulate.solver.error_estimate import estimated_error
from kept import ROOT
from solved_charges import relative_error

ACCURACY = (ROOT / "simulate/docs/accuracy.md").read_text("utf-8")


@dataclass(frozen=True)
class ReferenceCase:
    """A press that an independent solver has solved, with stretching and bending.

    Attributes:
        source: Name of the independent solver.
        film: The film.
        probe: The probe.
        at: Position (x, y), mm.
        force: Force, N.
        deflection: Deflection at the position, mm.
        charges: Touch charges of the electrodes, pC, by the sensor, such as "three-biaxial-area".
    """

    source: str
    film: Film
    probe: Probe
    at: tuple[float, float]
    force: float
    deflection: float
    charges: dict[str, np.ndarray]

    @cached_property
    def solved(self) -> Equilibrium:
        """Equilibrium of the press, from which the charges of all sensors are computed."""
        return press(self.film, self.probe, self.at, self.force)

    def sensor(self, key: str) -> Sensor:
        """Return the sensor of a key of `charges`."""
        layout, orientation, readout = key.split("-")
        return replace(load_sensor(f"{layout}-25um-{orientation}"), film=self.film, readout=readout)

    def __str__(self) -> str:
        film = self.film
        x, y = self.at
        probe = self.probe.rotated_notation
        return f"{film.thickness * 1e3:.0f}um-{film.pretension:g}MPa-{probe}-at({x:.0f},{y:.0f})-{self.force:g}N"


def read(name: str, source: str) -> list[ReferenceCase]:
    """Return the cases of a file in tests/data."""
    document = json.loads((ROOT / "tests/data" / name).read_text("utf-8"))
    radius, young, poisson = (document["film"][key] for key in ("radius_mm", "young_GPa", "poisson"))
    return [
        ReferenceCase(
            source,
            Film(radius, case["thickness_um"] * 1e-3, young * 1e3, poisson, case["pretension_MPa"]),
            probe_of(**case["probe"]),
            tuple(case["at_mm"]),
            case["force_N"],
            case["deflection_mm"],
            {key: np.array(list(charges.values())) for key, charges in case["touch_charge_pC"].items()},
        )
        for case in document["cases"]
    ]


def probe_of(shape: str, turn_deg: float = 0.0, **sizes_mm: float) -> Probe:
    """Return the probe that an entry of a file describes."""
    sizes = "x".join(map(str, sizes_mm.values()))
    return parse_probe(f"{shape}:{sizes}@{turn_deg}")


CASES = [*read("film_cases.json", "collocation, dolfinx"), *read("film_cases_skfem.json", "scikit-fem")]

NEAR = 4.0
"""Electrodes closer to the edge of the footprint than this distance (mm) have a larger tolerance."""


def allowed(case, sensor) -> np.ndarray:
    """Return the relative error that each electrode may have, shape (n_electrode,).

    The tolerance is 0.1 %. It is 0.2 % near the probe and for films of at least 1 mm.
    """
    distances = []
    for electrode in sensor.electrodes:
        nearest_point = np.clip(case.at, np.min(electrode.corners, axis=0), np.max(electrode.corners, axis=0))
        distances.append(np.hypot(*(nearest_point - case.at)) - case.probe.reach)
    is_near_probe = np.array(distances) < NEAR
    is_thick = case.film.thickness >= 1.0
    return np.where(is_near_probe | is_thick, 2e-3, 1e-3)


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.slow] * (i % 9 > 0), id=str(case)) for i, case in enumerate(CASES)]
)
def test_charges_and_deflection(case):
    """The charges of every layout, film and readout agree with the reference, with the theory that `press` chooses.

    Errors are relative to the charge. For scikit-fem, they are relative to the largest charge of the press, because the
    accuracy of scikit-fem is known in this form. The error that the simulator estimates, plus the error of the
    reference, is a bound for the largest error.
    """
    solved = case.solved
    largest_error = 0.0
    for key, expected in case.charges.items():
        sensor = case.sensor(key)
        charge = touch_charge(sensor, solved)
        error = np.abs(charge - expected)
        scale = np.abs(expected).max() if case.source == "scikit-fem" else np.abs(expected)
        assert np.all(error < allowed(case, sensor) * scale), (key, error / scale)
        if key.endswith("area"):
            largest_error = max(largest_error, relative_error(charge, expected))
    assert deflection(solved, np.array([case.at]))[0] == pytest.approx(case.deflection, rel=1e-3)
    reference_error = 3e-4
    assert largest_error <= estimated_error(solved, partial(touch_charge, sensor)) + reference_error


def worst_errors(case) -> tuple[float, float]:
    """Return the errors of the charges and of the deflection.

    The error of the charges is the largest one, relative to the largest charge. That of the deflection is relative.
    """
    solved = case.solved
    charge_errors = [
        relative_error(touch_charge(case.sensor(key), solved), expected) for key, expected in case.charges.items()
    ]
    return max(charge_errors), float(abs(deflection(solved, [case.at])[0] / case.deflection - 1.0))


@pytest.mark.slow
def test_accuracy_table_equals_the_errors_of_the_solver():
    """The errors in the table of simulate/docs/accuracy.md are those of the solver.

    The tolerance allows a difference of the last digits, because so small errors depend on the versions of the
    libraries.
    """
    row = r"^\| (.+) \| (\d+)(?: to (\d+))? um \| (\d+) \| ([\d.]+) % \| ([\d.]+) % \|$"
    rows = re.findall(row, ACCURACY, re.MULTILINE)
    remaining = dict(enumerate(CASES))
    for source, thinnest, thickest, count, *shown in rows:
        thickness_um = (float(thinnest), float(thickest or thinnest))
        numbers = [
            number
            for number, case in remaining.items()
            if case.source == source and thickness_um[0] <= round(1e3 * case.film.thickness) <= thickness_um[1]
        ]
        assert len(numbers) == int(count)
        cases = [remaining.pop(number) for number in numbers]
        np.testing.assert_allclose(
            np.max([worst_errors(case) for case in cases], axis=0), 0.01 * np.array(shown, dtype=float), atol=2e-5
        )
    assert not remaining
