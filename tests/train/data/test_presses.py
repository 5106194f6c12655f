"""Which presses train and which measure; of measured ones, the one split that every command makes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import DatasetError, PressError
from isocharge.serve import MeasuredPresses
from isocharge.simulate import Circle, Domain, Samples
from isocharge.train.data.presses import dataset_of, domain_of, held_out, is_measured, presses_of, split_by_position
from isocharge.train.training.source import TrainingData


def with_samples(dataset, **columns):
    return replace(dataset, samples=replace(dataset.samples, **columns))


def test_no_position_is_on_both_sides_and_the_seed_alone_decides(dataset):
    positions = np.random.default_rng(0).integers(0, 400, len(dataset.samples))
    repeated = with_samples(
        dataset, x_mm=dataset.samples.x_mm[positions], y_mm=dataset.samples.y_mm[positions]
    )  # many forces at each of 400 positions
    train, held = split_by_position(presses_of(repeated), 0.2, seed=3)
    seen, kept = ({tuple(row) for row in part.contact[:, :2]} for part in (train, held))
    assert not seen & kept
    assert len(train) + len(held) == len(dataset.samples)
    assert len(kept) == pytest.approx(0.2 * len(seen | kept), abs=1)
    again, other = (split_by_position(presses_of(repeated), 0.2, seed)[1].contact for seed in (3, 4))
    assert np.array_equal(again, held.contact)
    assert not np.array_equal(other, held.contact)


def test_the_domain_is_what_the_manifest_says_or_the_samples_show(dataset):
    assert domain_of(dataset) == Domain(8.0, (0.05, 2.0))
    samples = dataset.samples
    reach = np.hypot(samples.x_mm, samples.y_mm).max()
    forces = (samples.force_N.min(), samples.force_N.max())
    assert domain_of(replace(dataset, manifest={})) == Domain(reach, forces)
    with pytest.raises(DatasetError, match="do not hold the samples"):
        domain_of(replace(dataset, manifest={"ranges": {"radius_mm": 5.0}}))


def changed(dataset, value):
    charge = dataset.samples.charge_pC.copy()
    charge[17, 1] = value
    return with_samples(dataset, charge_pC=charge)


def few(dataset):
    columns = {name: column[:100] for name, column in dataset.samples.columns().items()}
    return replace(dataset, samples=Samples(**columns))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (few, "expected at least 500 presses at 50 positions, got 100 at 100"),
        (lambda d: with_samples(d, x_mm=0.0 * d.samples.x_mm, y_mm=0.0 * d.samples.y_mm), "got 6000 at 1"),
        (lambda d: with_samples(d, charge_pC=d.samples.charge_pC[:, :2]), "at least three electrodes"),
        (lambda d: with_samples(d, force_N=-d.samples.force_N), "sample 0: expected a positive force, got -"),
        (
            lambda d: with_samples(d, charge_pC=d.samples.charge_pC * [1, 0, 1]),
            "electrode 'B': expected charges that vary",
        ),
        (lambda d: changed(d, np.nan), r"sample 17: expected finite numbers, .*nan.* pC"),
    ],
)
def test_presses_that_cannot_train_are_refused(dataset, change, message):
    with pytest.raises(DatasetError, match=message):
        presses_of(change(dataset))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: changed(d, 1e30), r"^sample 17, column 'B': expected a value of the size of the others.*got 1e\+30"),
        (lambda d: changed(d, 1e39), r"^sample 17, column 'B': expected a charge in pC, got 1e\+39"),
        (lambda d: with_samples(d, charge_pC=d.samples.charge_pC[:, [0, 0, 2]]), "channels 'A', 'B': expected charges"),
        (lambda d: with_samples(d, charge_pC=1e-310 * d.samples.charge_pC), "channel 'A': expected charges in pC"),
    ],
)
def test_a_measured_dataset_with_a_fault_is_refused(dataset, change, message):
    measured = replace(dataset, manifest={})
    assert TrainingData.of(measured).presses.measured
    with pytest.raises(DatasetError, match=message):
        TrainingData.of(change(measured))


def contacts(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-6, 6, (count, 2)), rng.uniform(0.05, 2.0, count)])


def presses(contact: np.ndarray, charge: np.ndarray) -> MeasuredPresses:
    count = len(contact)
    return MeasuredPresses(
        contact, charge, np.full(count, 0.1), np.full(count, 0.01), ("A", "B", "C"), tuple(range(2, count + 2))
    )


@given(count=st.integers(50, 300), seed=st.integers(0, 999), forces=st.integers(1, 5))
@settings(max_examples=40, deadline=None)
def test_the_split_keeps_positions_together_and_does_not_hang_on_the_order(count, seed, forces):
    contact = np.repeat(contacts(count, seed), forces, axis=0)
    held = held_out(contact)
    assert held.sum() >= max(10, 0.2 * len(contact))
    assert held.sum() <= max(10, 0.2 * len(contact)) + forces
    assert not {tuple(p) for p in contact[held, :2]} & {tuple(p) for p in contact[~held, :2]}
    order = np.random.default_rng(seed).permutation(len(contact))
    assert np.array_equal(held_out(contact[order]), held[order])


def test_presses_held_out_of_all_are_first_to_be_held_out_of_a_part():
    contact = contacts(400, 1)
    part = contact[np.hypot(*contact[:, :2].T) < 5.0]
    held = {tuple(row) for row in contact[held_out(contact)]}
    of_part = {tuple(row) for row in part[held_out(part)]}
    assert len(of_part & held) >= min(len(of_part), len(held & {tuple(row) for row in part}))


def test_a_simulated_dataset_is_not_measured(dataset, sensor):
    assert not is_measured(dataset)
    assert is_measured(dataset_of(presses(contacts(60, 2), np.ones((60, 3))), sensor, Circle(1.0)))


def test_unknown_places_and_charges_do_not_count(sensor):
    contact = contacts(55, 3)
    charge = np.ones((55, 3))
    contact[0, 2] = charge[1, 0] = np.nan
    assert len(dataset_of(presses(contact, charge), sensor, Circle(1.0)).samples) == 53
    contact[2:7, :2] = np.nan
    with pytest.raises(PressError, match=r"at least 50 presses .* got 48 of 55.*train calibrate"):
        dataset_of(presses(contact, charge), sensor, Circle(1.0))
