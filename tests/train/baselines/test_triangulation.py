"""Triangulation as an estimator: on clean charges it finds the presses; the paper's form has to be told the force."""

import numpy as np
import pytest

from isocharge.simulate import noise_model
from isocharge.train.baselines import FittingTask, Triangulate
from isocharge.train.data.presses import LabelledPresses, domain_of, position_error, presses_of, split_by_position


@pytest.fixture(scope="module")
def forms(dataset, film):
    train, held = split_by_position(presses_of(dataset), 0.1, 0)
    return Triangulate(film).fit(FittingTask(train, held, domain_of(dataset), noise_model("reference")))


def test_clean_presses_are_found(dataset, forms):
    presses = LabelledPresses.of(dataset.samples)[np.arange(60)]
    for form in forms:
        contact = form.with_known_force(presses.contact[:, 2]).predict(presses.charge_pC)
        found = np.isfinite(contact[:, 0])
        assert found.mean() > 0.8
        assert np.median(position_error(contact[found], presses.contact[found])) < 0.02


def test_only_one_form_is_given_the_force(dataset, forms):
    unknown, given = forms
    assert (unknown.given_force, given.given_force) == (False, True)
    assert "force given" in given.name
    assert unknown.with_known_force(np.ones(3)) is unknown
    with pytest.raises(ValueError, match="with_known_force"):
        given.predict(dataset.samples.charge_pC[:2])
