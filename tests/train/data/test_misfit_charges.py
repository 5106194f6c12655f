"""Charges for the training of the misfit network."""

import numpy as np

from isocharge.simulate import noise_model
from isocharge.train.data.channel_noise import ChannelNoise
from isocharge.train.training.misfit_training import draw_charges

NOISE = ChannelNoise.alike(noise_model("reference"))


def test_charges_are_drawn_at_all_distances_from_presses():
    press = np.array([[300.0, 100.0, -20.0]])
    drawn = draw_charges(np.random.default_rng(0), press, NOISE, 20_000)
    distance = np.sort(np.abs(drawn - press) / NOISE.sigma(press), axis=1)
    is_good = distance[:, 2] < 3.0
    has_one_wrong_charge = (distance[:, 1] < 3.0) & (distance[:, 2] > 20.0)
    all_are_wrong = distance[:, 0] > 20.0
    for kind in (is_good, has_one_wrong_charge, all_are_wrong):
        assert 0.03 < kind.mean() < 0.6
    assert np.mean(np.abs(drawn[:, 0]) < 3.0) > 1e-4  # a dead electrode
    assert drawn.max() > 1_000.0
