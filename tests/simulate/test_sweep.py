"""A sweep: where its presses lie, what it writes, and that it can be repeated."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from isocharge.errors import OutputExists, SceneError
from isocharge.simulate import (
    Circle,
    ForwardMap,
    Sweep,
    load_sensor,
    press,
    read_dataset,
    run_sweep,
    touch_charge,
    write_sweep,
)
from isocharge.simulate.sweep import SHARD

QUICK = {"radius": 3e-3, "force_range": (0.5, 1.0)}
"""A small family: few solves are enough for it."""


def test_presses_are_uniform_over_the_disk():
    """The square of the distance and the angle are uniform, and independent of each other."""
    x, y, _, _ = Sweep(samples=4000, seed=1).presses()
    squared, angle = (x**2 + y**2) / 8e-3**2, np.arctan2(y, x)
    assert stats.kstest(squared, "uniform").pvalue > 0.05
    assert stats.kstest(angle, "uniform", args=(-np.pi, 2 * np.pi)).pvalue > 0.05
    counts = np.histogram2d(squared, angle, bins=(8, 8))[0]
    assert stats.chisquare(counts.ravel()).pvalue > 0.05
    assert squared.max() <= 1.0


def test_forces_are_uniform_in_the_logarithm():
    _, _, force, _ = Sweep(samples=4000, seed=2, force_range=(0.05, 2.0)).presses()
    assert stats.kstest(np.log(force), "uniform", args=(np.log(0.05), np.log(40.0))).pvalue > 0.05
    assert force.min() >= 0.05
    assert force.max() <= 2.0


def test_force_and_place_are_independent():
    x, y, force, _ = Sweep(samples=4000, seed=3).presses()
    assert np.abs(np.corrcoef([x, y, np.hypot(x, y), np.log(force)])[:3, 3]).max() < 0.05


def test_presses_fill_gaps_better_than_chance():
    """What the Sobol points are for: a tenth of the discrepancy of independent draws."""
    x, y, _, _ = Sweep(samples=1024, seed=4).presses()
    unit = np.stack([(x**2 + y**2) / 8e-3**2, np.mod(np.arctan2(y, x) / (2 * np.pi), 1.0)], axis=1)
    chance = np.random.default_rng(4).random((1024, 2))
    assert stats.qmc.discrepancy(unit) < 0.1 * stats.qmc.discrepancy(chance)


def test_seed_decides():
    first, again, other = (Sweep(samples=100, seed=seed).presses() for seed in (5, 5, 6))
    for a, b, c in zip(first[:3], again[:3], other[:3], strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.all(a != c)


def test_orientation():
    assert not Sweep(samples=100).presses()[3].any()
    turned = Sweep(samples=4000, orientation="random").presses()[3]
    assert stats.kstest(turned, "uniform", args=(0.0, 2 * np.pi)).pvalue > 0.05


@pytest.mark.parametrize("samples", [1, 2, 3, 1000])
def test_any_number_of_samples(samples):
    assert {len(column) for column in Sweep(samples=samples).presses()} == {samples}


def test_one_force_is_exact():
    assert set(Sweep(samples=50, force_range=(0.3, 0.3)).presses()[2].tolist()) == {0.3}


@pytest.mark.parametrize("samples", [0, -3])
def test_no_samples_is_an_error(samples):
    with pytest.raises(SceneError, match=f"samples: expected at least 1, got {samples}"):
        Sweep(samples=samples)


def test_too_many_samples():
    with pytest.raises(SceneError, match="samples: expected at most 10000000, got 10000001"):
        Sweep(samples=10_000_001)


def test_unknown_orientation():
    with pytest.raises(SceneError, match="orientation: expected 'fixed' or 'random', got 'Random'"):
        Sweep(orientation="Random")


# What is written


def test_samples_are_the_presses_and_their_charges(small_dataset):
    read = read_dataset(small_dataset)
    x, y, force, _ = Sweep(samples=500, seed=7).presses()
    np.testing.assert_allclose(read.samples.x_mm, x * 1e3, rtol=1e-14)
    np.testing.assert_allclose(read.samples.y_mm, y * 1e3, rtol=1e-14)
    np.testing.assert_array_equal(read.samples.force_N, force)
    assert set(read.samples.probe) == {"circle:1.0"}
    for i in (0, 123, 499):
        solved = press(read.sensor.film, Circle(1e-3), (x[i], y[i]), force[i])
        np.testing.assert_allclose(read.samples.charge_pC[i], 1e12 * touch_charge(read.sensor, solved), rtol=1e-3)


def test_manifest_of_a_sweep(small_dataset, three_map):
    manifest = read_dataset(small_dataset).manifest
    assert manifest["probes"] == ["circle:1.0"]
    assert manifest["ranges"] == {"radius_mm": 8.0, "force_N": [0.05, 2.0], "orientation": "fixed"}
    assert (manifest["seed"], manifest["noise"], manifest["samples"]) == (7, "clean", 500)
    assert manifest["solver"] == {
        "theory": "nonlinear membrane",
        "order": 4,
        "around": 8,
        "rings": 6,
        "solves": len(three_map.table),
        "interpolation_error": three_map.error,
    }


def test_same_seed_same_bytes(small_dataset, three_map, tmp_path):
    again = write_sweep(tmp_path / small_dataset.name, (three_map,), Sweep(samples=500, seed=7))
    assert files(again) == files(small_dataset)
    other = write_sweep(tmp_path / "other", (three_map,), Sweep(samples=500, seed=8))
    assert read_dataset(other).sha256 != read_dataset(again).sha256


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_bytes_do_not_depend_on_the_executor(two_processes, tmp_path):
    sensor, sweep = load_sensor("three-25um-biaxial"), Sweep(samples=50, **QUICK)
    here = run_sweep(tmp_path / "a" / "presses", sensor, (Circle(1e-3),), sweep)
    there = run_sweep(tmp_path / "b" / "presses", sensor, (Circle(1e-3),), sweep, executor=two_processes)
    assert files(here) == files(there)


def test_probes_take_turns(three_map, tmp_path):
    """Each gets its own charges; an odd number of samples, and a probe that gets none."""
    sensor, wide = three_map.sensor, ForwardMap.build(three_map.sensor, Circle(2e-3), **QUICK)
    sweep = Sweep(samples=5, **QUICK)
    read = read_dataset(write_sweep(tmp_path / "two", (three_map, wide), sweep))
    assert read.samples.probe.tolist() == ["circle:1.0", "circle:2.0", "circle:1.0", "circle:2.0", "circle:1.0"]
    assert read.manifest["probes"] == ["circle:1.0", "circle:2.0"]
    for i in (0, 3):
        at = (1e-3 * read.samples.x_mm[i], 1e-3 * read.samples.y_mm[i])
        solved = press(sensor.film, Circle((1e-3, 2e-3)[i % 2]), at, read.samples.force_N[i])
        np.testing.assert_allclose(read.samples.charge_pC[i], 1e12 * touch_charge(sensor, solved), rtol=1e-3)
    one = read_dataset(write_sweep(tmp_path / "one", (three_map, wide), Sweep(samples=1, **QUICK)))
    assert one.samples.probe.tolist() == ["circle:1.0"]


def test_large_sweeps_are_cut_into_shards(three_map, tmp_path):
    folder = write_sweep(tmp_path / "large", (three_map,), Sweep(samples=SHARD + 10))
    read = read_dataset(folder)
    assert [shard["samples"] for shard in read.manifest["shards"]] == [SHARD, 10]
    np.testing.assert_allclose(read.samples.x_mm, 1e3 * Sweep(samples=SHARD + 10).presses()[0])


def test_an_exception_half_way_leaves_nothing(three_map, tmp_path, monkeypatch):
    monkeypatch.setattr("isocharge.simulate.sweep.SHARD", 100)
    calls = []
    forward = type(three_map).forward

    def second_fails(self, *press):
        calls.append(press)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return forward(self, *press)

    monkeypatch.setattr(type(three_map), "forward", second_fails)
    with pytest.raises(KeyboardInterrupt):
        write_sweep(tmp_path / "presses", (three_map,), Sweep(samples=300))
    assert len(calls) == 2
    assert list(tmp_path.iterdir()) == []


def test_existing_folder_is_refused_before_any_work(tmp_path):
    (tmp_path / "presses").mkdir()
    with pytest.raises(OutputExists):
        run_sweep(
            tmp_path / "presses",
            load_sensor("three-25um-biaxial"),
            (Circle(1e-3),),
            Sweep(),
            progress=lambda done, total: pytest.fail(f"worked: {done} of {total}"),
        )


@pytest.mark.parametrize(
    ("sweep", "message"),
    [
        (Sweep(radius=44.5e-3), "probe off the film"),
        (Sweep(radius=-1e-3), "radius: expected a positive number"),
        (Sweep(force_range=(-0.1, 1.0)), "force range: expected 0 < MIN"),
    ],
)
def test_impossible_sweeps_leave_nothing(tmp_path, sweep, message):
    with pytest.raises(SceneError, match=message):
        run_sweep(tmp_path / "presses", load_sensor("three-25um-biaxial"), (Circle(1e-3),), sweep)
    assert list(tmp_path.iterdir()) == []


def test_no_probes(tmp_path):
    with pytest.raises(SceneError, match="probes: expected at least one, got none"):
        run_sweep(tmp_path / "presses", load_sensor("three-25um-biaxial"), (), Sweep())
