"""Which presses train and which measure."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import DatasetError
from isocharge.simulate import Samples
from isocharge.train.data.presses import domain_of, presses_of, split_by_position


def with_samples(dataset, **columns):
    samples = replace(dataset.samples, **columns)
    return replace(dataset, samples=samples)


def cut(samples, rows):
    return Samples(**{name: column[rows] for name, column in samples.columns().items()})


def test_no_position_is_on_both_sides(dataset):
    positions = np.random.default_rng(0).integers(0, 400, len(dataset.samples))
    repeated = with_samples(
        dataset, x_mm=dataset.samples.x_mm[positions], y_mm=dataset.samples.y_mm[positions]
    )  # many forces at each of 400 positions
    train, held = split_by_position(presses_of(repeated), 0.2, seed=3)
    seen = {tuple(row) for row in train.contact[:, :2]}
    kept = {tuple(row) for row in held.contact[:, :2]}
    assert not seen & kept
    assert len(train) + len(held) == len(dataset.samples)
    assert len(kept) == pytest.approx(0.2 * len(seen | kept), abs=1)


def test_the_split_depends_on_the_seed_only(dataset):
    again = [split_by_position(presses_of(dataset), 0.1, seed)[1].contact for seed in (1, 1, 2)]
    assert np.array_equal(again[0], again[1])
    assert not np.array_equal(again[0], again[2])


def test_the_domain_is_what_the_manifest_says(dataset):
    domain = domain_of(dataset)
    assert domain.radius_mm == 8.0
    assert domain.force_range_N == (0.05, 2.0)


def test_measured_data_without_ranges_show_their_domain(dataset):
    domain = domain_of(replace(dataset, manifest={}))
    assert domain.radius_mm == np.hypot(dataset.samples.x_mm, dataset.samples.y_mm).max()
    assert domain.force_range_N == (dataset.samples.force_N.min(), dataset.samples.force_N.max())


def test_too_few_presses(dataset):
    few = replace(dataset, samples=cut(dataset.samples, slice(0, 100)))
    with pytest.raises(DatasetError, match="expected at least 500 presses at 50 positions, got 100 at 100"):
        presses_of(few)


def test_a_single_position(dataset):
    one = with_samples(dataset, x_mm=np.zeros(len(dataset.samples)), y_mm=np.zeros(len(dataset.samples)))
    with pytest.raises(DatasetError, match="got 6000 at 1"):
        presses_of(one)


def test_two_electrodes(dataset):
    two = with_samples(dataset, charge_pC=dataset.samples.charge_pC[:, :2])
    with pytest.raises(DatasetError, match="at least three electrodes"):
        presses_of(two)


def test_a_negative_charge_is_named(dataset):
    charge = dataset.samples.charge_pC.copy()
    charge[17, 1] = -3.0
    with pytest.raises(DatasetError, match="sample 17: expected positive force and charges"):
        presses_of(with_samples(dataset, charge_pC=charge))


def test_a_number_that_is_not_finite_is_named(dataset):
    charge = dataset.samples.charge_pC.copy()
    charge[17, 1] = np.nan
    with pytest.raises(DatasetError, match=r"sample 17: expected finite numbers, .*nan.* pC"):
        presses_of(with_samples(dataset, charge_pC=charge))
