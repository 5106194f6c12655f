"""Names beside a plot."""

import numpy as np

from isocharge.train.report.speed import spread


def test_names_are_kept_apart_in_order():
    rng = np.random.default_rng(0)
    for _ in range(20):
        wanted = sorted(rng.random(12))
        heights = spread(wanted, 0.05)
        assert (np.diff(heights) >= 0.05 - 1e-12).all()
        assert heights[-1] <= 1.0 + 1e-12


def test_names_that_are_apart_stay():
    assert spread([0.1, 0.4, 0.9], 0.05) == [0.1, 0.4, 0.9]
