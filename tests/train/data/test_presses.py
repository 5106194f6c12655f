"""Which presses train and which measure."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import DatasetError
from isocharge.simulate import Domain, Samples
from isocharge.train.data.presses import domain_of, presses_of, split_by_position


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
    reach, forces = np.hypot(samples.x_mm, samples.y_mm).max(), (samples.force_N.min(), samples.force_N.max())
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
        (lambda d: changed(d, -3.0), "sample 17: expected positive force and charges"),
        (lambda d: changed(d, np.nan), r"sample 17: expected finite numbers, .*nan.* pC"),
    ],
)
def test_presses_that_cannot_train_are_refused(dataset, change, message):
    with pytest.raises(DatasetError, match=message):
        presses_of(change(dataset))
