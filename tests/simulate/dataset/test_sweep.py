"""Contents and reproducibility of swept datasets, and error messages."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tests.simulate.conftest import COARSE

from isocharge.common.errors import SceneError
from isocharge.common.progress import listening
from isocharge.simulate import (
    Circle,
    Ellipse,
    ForwardMap,
    Polygon,
    Probe,
    Sweep,
    load_sensor,
    parse_probe,
    read_dataset,
    run_sweep,
)
from isocharge.simulate.dataset import sweep as sweep_module
from isocharge.simulate.dataset.sweep import outside_map, solve_maps, write_sweep
from isocharge.simulate.forward.family import NodeCount
from solved_charges import solved_charge

PROBE = Circle(1.0)
SENSOR = load_sensor("three-25um-biaxial")


def small(samples: int = 60, **changes) -> Sweep:
    sweep = {"radius": 3.0, "force_range": (1.0, 1.0), "samples": samples, "seed": 7, "outside": 50}
    return Sweep(**sweep | changes)


def spy_map(forward_map: ForwardMap, probe: Probe) -> SimpleNamespace:
    """Return a substitute for a map of a probe, whose three charges are the x, y and orientation of its arguments."""
    names = ("sensor", "electrodes", "theory", "resolution", "solves", "error")
    attributes = {name: getattr(forward_map, name) for name in names}

    def charges(contact, orientation):
        return np.column_stack([contact[:, :2], np.rad2deg(orientation)])

    return SimpleNamespace(probe=probe, charges=charges, **attributes)


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


# What is written


def test_samples_contain_the_presses_and_their_charges(small_dataset):
    read = read_dataset(small_dataset)
    x, y, force = Sweep(samples=500, seed=7).contacts().T
    for column, expected in ((read.samples.x_mm, x), (read.samples.y_mm, y), (read.samples.force_N, force)):
        np.testing.assert_array_equal(column, expected)
    assert set(read.samples.probe) == {"circle:1.0"}
    for i in (0, 123, 499):
        expected = solved_charge(read.sensor, PROBE, (x[i], y[i]), force[i])
        np.testing.assert_allclose(read.samples.charge_pC[i], expected, rtol=1e-3)


def test_manifest_of_a_sweep(small_dataset, three_map):
    manifest = read_dataset(small_dataset).manifest
    mesh = three_map.resolution
    ranges = {"radius_mm": 8.0, "force_N": [0.05, 2.0], "orientation": "fixed"}
    assert (manifest["probes"], manifest["ranges"]) == (["circle:1.0"], ranges)
    assert manifest["sampling"].startswith("scrambled Sobol")
    assert (manifest["seed"], manifest["noise"], manifest["samples"]) == (7, "clean", 500)
    assert manifest["solver"] == {
        "theory": three_map.theory.name,
        "mesh": {"circle:1.0": f"order {mesh.order}, around {mesh.around}, rings {mesh.rings}, rim {mesh.rim}"},
        "solves": three_map.solves,
        "interpolation_error": three_map.error,
    }


def test_presses_outside_the_radius_reach_up_to_the_clamp(small_dataset):
    """Their charges are those of the coarse map, which is accurate to 0.5 % within two thirds of the film radius."""
    read = read_dataset(small_dataset)
    outside = read.outside
    distance = np.hypot(outside.x_mm, outside.y_mm)
    assert distance.min() >= 8.0
    assert distance.max() == pytest.approx(42.8, abs=0.01)
    assert np.mean(distance < 25.0) == pytest.approx((25.0**2 - 8.0**2) / (42.8**2 - 8.0**2), abs=1e-3)
    for i in np.flatnonzero(distance < 30.0)[:3]:
        expected = solved_charge(read.sensor, PROBE, (outside.x_mm[i], outside.y_mm[i]), outside.force_N[i])
        np.testing.assert_allclose(outside.charge_pC[i], expected, rtol=5e-3)
    about = read.manifest["outside"]
    assert (about["samples"], about["probe"], about["radius_mm"]) == (2048, "circle:1.0", [8.0, 42.8])
    assert read.manifest["yield_force_N"] == pytest.approx(0.873, rel=0.005)  # with a mesh of order 9


@pytest.mark.parametrize("changes", [{"outside": 0}, {"radius": 42.0}])
def test_a_sweep_without_presses_outside(changes):
    """No presses are requested, or the ring between the radius and the clamp is narrow."""
    assert outside_map(SENSOR, (PROBE,), small(**changes)) is None


def test_smallest_width_of_the_ring_outside_is_relative_to_the_film(monkeypatch):
    monkeypatch.setattr(sweep_module, "whole_film_map", lambda *_, **__: "map")
    sensor = replace(SENSOR, film=replace(SENSOR.film, radius=16.0))
    assert outside_map(sensor, (Circle(0.1),), small(radius=14.5)) == "map"


def test_run_sweep_writes_the_same_bytes_as_write_sweep_and_reports_progress(tmp_path):
    """`run_sweep` builds the forward map, and `write_sweep` uses a given map. The datasets are equal."""
    reports: dict[str, list] = {}
    with listening(lambda title, done, total, _: reports.setdefault(title, []).append((done, total))):
        drafted = run_sweep(tmp_path / "b" / "presses", SENSOR, (PROBE,), small(), COARSE)
    maps = [ForwardMap.build(SENSOR, PROBE, 3.0, (1.0, 1.0), COARSE)]
    with pytest.raises(SceneError, match="one forward map of this sensor for each probe"):
        run_sweep(tmp_path / "c", SENSOR, (PROBE, Circle(2.0)), small(), maps=maps)
    assert len(read_dataset(drafted).outside) == 50
    assert files(drafted) == files(write_sweep(tmp_path / "a" / "presses", maps, small()))
    assert [path.name for path in drafted.parent.iterdir()] == ["presses"]
    assert reports["pressing"] == [(0, 110), (60, 110), (110, 110)]
    done, total = reports["solving the film"][-1]
    assert done == total


def test_orientation_is_the_sum_of_probe_angle_and_rotation(three_map, tmp_path, monkeypatch):
    """The dataset contains the sum of both angles. The forward map receives the rotation of the press only.

    The sweeps have two shards, and each press has its own charges.
    """
    monkeypatch.setattr(sweep_module, "SHARD_SIZE", 600)
    monkeypatch.setattr(sweep_module, "yield_force", lambda *_: None)
    probes = [parse_probe(text) for text in ("rectangle:4.0x2.0@30", "triangle:4.0@-30", "circle:1.0@50")]
    for orientation in ("fixed", "random"):
        sweep = Sweep(samples=999, orientation=orientation, outside=0)
        maps = [spy_map(three_map, probe) for probe in probes]
        read = read_dataset(write_sweep(tmp_path / orientation, maps, sweep)).samples
        assert read.probe.tolist() == ["rectangle:4.0x2.0", "triangle:4.0", "circle:1.0"] * 333
        np.testing.assert_array_equal(read.charge_pC[:, :2].T, [read.x_mm, read.y_mm])
        rotation = read.charge_pC[:, 2]
        total = read.orientation_deg
        difference = total - rotation - np.tile([30.0, -30.0, 0.0], 333)
        np.testing.assert_allclose((difference + 180.0) % 360.0, 180.0, atol=1e-6)
        assert (total >= 0.0).all()
        assert (total < 360.0).all()
    assert set(total[read.probe == "triangle:4.0"].round(3).tolist()) != {330.0}
    assert read.probes == ("circle:1.0", "rectangle:4.0x2.0", "triangle:4.0")
    fixed = read_dataset(tmp_path / "fixed").samples
    assert fixed.orientation_deg[:3].tolist() == [30.0, 330.0, 0.0]
    assert fixed.probes == ("circle:1.0", "rectangle:4.0x2.0@30", "triangle:4.0@330")


# Errors


@pytest.mark.parametrize(("orientation", "is_oriented"), [("fixed", True), ("random", False)])
def test_maps_of_a_sweep_on_an_uneven_film_allow_its_orientations(monkeypatch, orientation, is_oriented):
    monkeypatch.setattr("isocharge.simulate.forward.family.ASYMMETRIC_NODE_COUNTS", (NodeCount(1, 1, (1, 1)),) * 2)
    monkeypatch.setattr("isocharge.simulate.forward.forward_map.INTERPOLATION_ERROR", np.inf)
    sensor = replace(SENSOR, film=replace(SENSOR.film, oval=0.01))
    (forward_map,) = solve_maps(sensor, (Ellipse(2.0, 1.0),), small(orientation=orientation), COARSE)
    assert forward_map.family.is_oriented == is_oriented


def test_shards_of_a_probe_with_many_corners_fit_into_a_file():
    angle = 2.0 * np.pi * np.arange(60) / 60
    polygon = Polygon.of(np.stack([1.3 * np.cos(angle), np.sin(angle)], axis=1))
    rows = sweep_module._shard_size([PROBE, polygon], sweep_module.SHARD_SIZE)
    assert 1000 < rows < sweep_module.SHARD_SIZE
    assert np.full(rows, polygon.notation).nbytes < 2**26
    assert sweep_module._shard_size([PROBE], sweep_module.SHARD_SIZE) == sweep_module.SHARD_SIZE
