"""Changes of the last layer: standard deviations that fit the errors of a network."""

import numpy as np
import pytest

from isocharge.simulate import noise_model
from isocharge.train.training.network import fold_network
from isocharge.train.training.output_regression import fit_std

NOISE = noise_model("reference")


def relative_errors(network, presses):
    """Return the errors of x, y and ln F over their standard deviations, shape (n, 3)."""
    contact, std, *_ = network.outputs(presses.noisy(NOISE, seed=5))
    error = presses.contact - contact
    error[:, 2] = contact[:, 2] * np.log(presses.contact[:, 2] / contact[:, 2])
    return error / std


def test_wrong_standard_deviations_are_corrected_and_the_contacts_stay(trained):
    """In each third of the forces, the 68 % intervals of presses that were not used contain 68 % of the contacts."""
    split = trained.split
    wrong = fold_network(trained.network).with_scaled_std(1.5, 0.6)
    presses = split.train[np.arange(20_000) % len(split.train)]
    fitted = fit_std(wrong, presses.noisy(NOISE, seed=4), presses.contact)

    tested = split.test[np.arange(20_000) % len(split.test)]
    charge = tested.noisy(NOISE, seed=5)
    np.testing.assert_allclose(fitted.outputs(charge)[0], wrong.outputs(charge)[0], rtol=1e-9, atol=1e-9)
    assert np.mean(np.abs(relative_errors(wrong, tested)) < 1.0, axis=0)[0] > 0.8
    for rows in np.array_split(np.argsort(tested.contact[:, 2]), 3):
        coverage = np.mean(np.abs(relative_errors(fitted, tested[rows])) < 1.0, axis=0)
        assert coverage == pytest.approx([0.68] * 3, abs=0.05)
