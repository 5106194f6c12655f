"""Search for a guard electrode, with charges in closed form for which the mirror region is known."""

import json
from dataclasses import dataclass

import numpy as np
import pytest

from isocharge.common.errors import InputError
from isocharge.simulate import Domain, FunctionMap, Sensor, load_sensor
from isocharge.simulate.forward.charge_map import differences
from isocharge.simulate.identifiability import mirror_region
from isocharge.simulate.layout import guard
from isocharge.simulate.layout.guard import design_guard, guard_case

FORCES = (0.05, 2.0)


@dataclass(frozen=True)
class InverseDistanceMap:
    """Charges in proportion to the force over the distance between the centre of an electrode and the press.

    Inversion in the circle of 10 mm divides the distances from all points of the circle by the same factor. Electrodes
    on this circle therefore cannot notice a press outside of it, and an electrode elsewhere can.
    """

    sensor: Sensor
    domain: Domain

    @property
    def electrodes(self):
        return self.sensor.electrode_names

    def charges(self, contact):
        centres = np.array([electrode.centre for electrode in self.sensor.electrodes])
        distance = np.linalg.norm(contact[:, None, :2] - centres, axis=2)
        return 10_000.0 * contact[:, 2:] / np.hypot(distance, 0.1)

    def derivatives(self, contact):
        return differences(self.charges, contact)


@pytest.fixture
def _closed_form(monkeypatch):
    """Charges in closed form instead of solved ones, and few presses."""
    monkeypatch.setattr(
        guard.ForwardMap,
        "build",
        lambda sensor, _, radius, forces, **__: InverseDistanceMap(sensor, Domain(radius, forces)),
    )
    monkeypatch.setattr(
        guard, "whole_film_map", lambda sensor, _, forces, **__: InverseDistanceMap(sensor, Domain(42.8, forces))
    )
    monkeypatch.setattr(
        guard.ChargeSpline,
        "of",
        lambda forward_map: FunctionMap(forward_map.charges, forward_map.electrodes, forward_map.domain),
    )
    monkeypatch.setattr(mirror_region, "N_RINGS", 6)
    monkeypatch.setattr(mirror_region, "N_SECTORS", 8)
    monkeypatch.setattr(mirror_region, "N_FORCES", 2)
    monkeypatch.setattr(guard, "PRESS_COUNTS", (5, 6, 2))
    monkeypatch.setattr(guard, "GRID_STEPS", 3)


@pytest.mark.usefixtures("_closed_form")
def test_a_guard_away_from_the_circle_of_the_electrodes_removes_the_mirror_region():
    case = guard_case(load_sensor("four-25um-biaxial"), 8.0)
    found = design_guard(case)
    assert found.region_before.total_share > 0.5
    assert found.region_after.total_share < 0.01
    assert abs(np.hypot(*found.guard.centre) - 10.0) > 2.0
    assert found.limits_after["rms_mm"] < found.limits_before["rms_mm"]
    assert found.sensor.guard_names == ("E",)
    assert found.sensor.electrodes[:4] == case.sensor.electrodes


@pytest.mark.slow
@pytest.mark.usefixtures("_closed_form")
def test_the_command_writes_a_sensor_with_a_guard_that_other_commands_read(command, tmp_path):
    folder = tmp_path / "guarded"
    words = ("simulate", "design", "three-25um-biaxial", "--guard", "--radius", "8", "--workers", "1", "-o", folder)
    code, out, err = command(*words)
    assert code == 0, err
    assert "cannot be noticed" in err
    sensor = load_sensor(folder / "sensor.toml")
    assert sensor.guard_names == ("D",)
    results = json.loads((folder / "design.json").read_text())
    assert results["guard"] == {"name": "D", "centre_mm": pytest.approx(sensor.electrodes[-1].centre)}
    assert results["after"]["mirror_region"]["share"] < results["before"]["mirror_region"]["share"]
    assert f"{100.0 * results['before']['mirror_region']['share']:.2g} % without electrode D" in err
    assert f"{results['before']['position_limit']['rms_mm']:.5g}" in out
    assert sorted(path.name for path in folder.iterdir()) == [
        *("design.json", "layout.dxf", "layout.svg", "mirror.png", "mirror_before.png", "sensor.toml"),
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ("--guard", "--electrodes", "5"),
            "--guard: keeps all electrodes of the sensor and adds one, got --electr",
        ),
        (("--guard", "--keep", "A", "--known"), "got --keep, --known as well; leave them out"),
        ((), "--electrodes: expected the number of electrodes, got none; give it, or --guard"),
    ],
)
def test_options_that_do_not_fit_the_search_are_refused(refused, tmp_path, words, message):
    refused("simulate", "design", "three-25um-biaxial", "--radius", "8", "-o", tmp_path / "d", *words, message=message)


@pytest.mark.usefixtures("_closed_form")
def test_a_guard_on_the_circle_of_the_electrodes_notices_nothing():
    sensor = load_sensor("four-25um-biaxial")
    case = guard_case(sensor, 8.0)
    inner_map = InverseDistanceMap(sensor, Domain(8.0, FORCES))
    outer_map = InverseDistanceMap(sensor, Domain(42.8, FORCES))
    on_circle = guard._with_guard(case, 10.0 * np.array([np.cos(0.8), np.sin(0.8)]))
    elsewhere = guard._with_guard(case, np.array([20.0, 0.0]))
    share_on_circle, share_elsewhere = guard._estimated_shares(case, inner_map, outer_map, [on_circle, elsewhere])
    assert share_on_circle > 0.4
    assert share_elsewhere < 0.01


def test_a_guard_that_fits_nowhere_is_refused():
    with pytest.raises(InputError, match="side: no square of 44 mm fits between the electrodes"):
        design_guard(guard_case(load_sensor("four-25um-biaxial"), 8.0, side=44.0))


def test_a_ninth_electrode_is_refused():
    with pytest.raises(InputError, match="electrodes: expected 3 to 8, got 9"):
        guard_case(load_sensor("eight-25um-biaxial"), 8.0)
