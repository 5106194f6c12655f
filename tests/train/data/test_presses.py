"""Tests of the split of presses into training and test presses, and of the checks of datasets."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.train.measured import measured_presses, with_samples

from drawn_contacts import draw_contacts
from isocharge.common.errors import DatasetError, PressError
from isocharge.simulate import Circle, Domain, parse_probe
from isocharge.train.data.presses import (
    LabelledPresses,
    dataset_of,
    domain_of,
    is_measured,
    merged_places,
    place_count,
    position_ranks,
    presses_of,
    split_by_position,
)
from isocharge.train.training.training_data import TrainingData

PROBE = Circle(1.0)


def positions_of(contact):
    """Return the set of the positions (x, y) of contacts, mm."""
    return {tuple(position) for position in contact[:, :2]}


def test_domain_is_that_of_the_manifest(dataset):
    assert domain_of(dataset) == Domain(8.0, (0.05, 2.0))
    for ranges, message in (
        ({"radius_mm": 5.0, "force_N": [0.05, 2.0]}, "radius_mm 5 .* do not hold the samples, which reach 7.99"),
        ({"radius_mm": 8.0}, "manifest ranges.*force_N"),
    ):
        with pytest.raises(DatasetError, match=message):
            domain_of(replace(dataset, manifest={"ranges": ranges}))
    with pytest.raises(DatasetError, match=r"do not hold the samples, which reach .* and -1\.99\d* to -0\.05"):
        TrainingData.of(with_samples(dataset, force_N=-dataset.samples.force_N))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            lambda d: replace(d, samples=d.samples[np.arange(100)]),
            "expected at least 500 presses at 50 positions, got 100 at 100",
        ),
        (lambda d: with_samples(d, charge_pC=d.samples.charge_pC[:, :2]), "at least three electrodes"),
        (
            lambda d: with_samples(d, charge_pC=d.samples.charge_pC * [1, 0, 1]),
            "electrode 'B': expected charges that vary",
        ),
    ],
)
def test_dataset_that_a_network_cannot_be_trained_on_is_refused(dataset, change, message):
    with pytest.raises(DatasetError, match=message):
        presses_of(change(dataset))


def test_a_simulated_dataset_with_one_force_is_refused(dataset):
    """The model would answer 1 N to every press, with a standard deviation of nearly zero."""
    with pytest.raises(DatasetError, match="expected presses with different forces, got 1 N in all of 6000"):
        TrainingData.of(with_samples(dataset, force_N=np.ones(6000)))


def test_a_measured_dataset_is_refused_where_simulated_presses_are_expected(dataset):
    with pytest.raises(DatasetError, match=r"expected simulated presses, got a measured dataset.*train fit PRESSES"):
        TrainingData.of(replace(dataset, manifest={}))


@given(count=st.integers(50, 300), seed=st.integers(0, 999), forces=st.integers(1, 5))
@settings(max_examples=40, deadline=None)
def test_split_keeps_positions_together_and_does_not_depend_on_the_order_or_on_other_presses(count, seed, forces):
    contact = np.repeat(draw_contacts(seed, count, 8.0, (0.05, 2.0)), forces, axis=0)
    presses = LabelledPresses(contact, np.ones((len(contact), 3)))
    first, second = split_by_position(presses, 0.2)
    assert len(first) + len(second) == len(presses)
    assert 0.2 * count <= len(positions_of(second.contact)) <= 0.2 * count + 1
    assert not positions_of(first.contact) & positions_of(second.contact)
    order = np.random.default_rng(seed).permutation(len(contact))
    _, reordered = split_by_position(presses[order], 0.2)
    assert positions_of(reordered.contact) == positions_of(second.contact)

    # The order of the positions of a part is that of the same positions among all presses.
    part = contact[: len(contact) // 2]
    of_part, of_all = (np.argsort(ranks, kind="stable") for ranks in (position_ranks(part), position_ranks(contact)))
    assert np.array_equal(of_part, of_all[of_all < len(part)])


def test_positions_of_an_encoder_with_noise_are_merged_to_places_but_not_scattered_positions(sensor):
    places = np.argwhere(np.ones((6, 6)))
    reported = np.repeat(places, 60, axis=0) + np.random.default_rng(1).normal(0.0, 0.005, (60 * len(places), 2))
    contact = np.column_stack([reported, np.ones(len(reported))])
    merged = merged_places(contact)
    assert place_count(merged) == len(places)
    samples = dataset_of(measured_presses(contact, np.ones((len(contact), 3))), sensor, PROBE).samples
    assert np.array_equal(samples.x_mm, merged[:, 0])
    np.testing.assert_allclose(merged[::60, :2], places, atol=0.003)
    scattered = draw_contacts(3, 5000, 8.0, (0.05, 2.0))
    assert np.abs(merged_places(scattered) - scattered).max() < 0.04


def test_measured_presses_keep_the_orientation_of_their_probe(sensor):
    presses = measured_presses(draw_contacts(2, 60, 8.0, (0.05, 2.0)), np.ones((60, 3)))
    probe = parse_probe("rectangle:4x2@30")
    dataset = dataset_of(presses, sensor, probe)
    assert is_measured(dataset)
    samples = dataset.samples
    assert samples.orientation_deg == pytest.approx(30.0)
    described_probe = parse_probe(str(samples.probe[0])).rotated(np.deg2rad(samples.orientation_deg[0]))
    assert described_probe.angle == pytest.approx(probe.angle)


def test_presses_with_unknown_places_forces_or_charges_are_left_out(sensor):
    contact = draw_contacts(3, 55, 8.0, (0.05, 2.0))
    charge = np.ones((55, 3))
    contact[0, 2] = np.nan
    charge[1, 0] = np.nan
    assert len(dataset_of(measured_presses(contact, charge), sensor, PROBE).samples) == 53
    contact[2:7, :2] = np.nan
    with pytest.raises(PressError, match=r"at least 50 presses .* got 48 of 55.*train calibrate"):
        dataset_of(measured_presses(contact, charge), sensor, PROBE)
