"""Measured presses: which datasets are measured, and the one split that every command makes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import PressError
from isocharge.serve import MeasuredPresses
from isocharge.simulate import Circle
from isocharge.train.data.presses import dataset_of, held_out, is_measured


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
    contact, charge = contacts(55, 3), np.ones((55, 3))
    contact[0, 2] = charge[1, 0] = np.nan
    assert len(dataset_of(presses(contact, charge), sensor, Circle(1.0)).samples) == 53
    contact[2:7, :2] = np.nan
    with pytest.raises(PressError, match=r"at least 50 presses .* got 48 of 55.*train calibrate"):
        dataset_of(presses(contact, charge), sensor, Circle(1.0))
