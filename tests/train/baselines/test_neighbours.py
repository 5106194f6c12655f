"""Neighbours and tables against brute force."""

import numpy as np
from sklearn.linear_model import LinearRegression

from isocharge.train.baselines import InterpolatedTable, NearestEntry, NearestNeighbours
from isocharge.train.baselines.table import affine_maps


def test_the_mean_of_the_nearest_by_brute_force(task, test_presses):
    direct = NearestNeighbours().fit(task)[-1]
    charge = test_presses.charge_pC[:40]
    noisy = task.noisy_train(1)
    known, asked = direct.features(noisy.charge_pC), direct.features(charge)
    unit = task.domain.to_unit(noisy.contact)
    plane = LinearRegression().fit(known, unit)
    rows = np.argsort(np.linalg.norm(asked[:, None] - known[None], axis=2), axis=1)[:, : direct.k]
    found = plane.predict(asked) + (unit - plane.predict(known))[rows].mean(axis=1)
    expected = np.column_stack([8.0 * found[:, :2], np.exp(np.log(np.sqrt(0.1)) + 0.5 * np.log(40.0) * found[:, 2])])
    np.testing.assert_allclose(direct.predict(charge), expected, rtol=1e-9, atol=1e-9)


def test_the_nearest_entry_by_brute_force(task, test_presses):
    table = NearestEntry().fit(task)[0]
    charge = test_presses.charge_pC[:40]
    distance = np.linalg.norm(table.features(charge)[:, None] - table.features(task.train.charge_pC)[None], axis=2)
    np.testing.assert_allclose(table.predict(charge), task.train.contact[distance.argmin(axis=1)], rtol=1e-9)


def test_affine_maps_find_an_affine_map():
    rng = np.random.default_rng(0)
    features, slope, shift = rng.normal(size=(500, 3)), rng.normal(size=(3, 3)), rng.normal(size=3)
    entries = features[:50]
    maps = affine_maps(entries, features, features @ slope + shift, 20)
    np.testing.assert_allclose(maps[:, -1], entries @ slope + shift, atol=1e-4)
    np.testing.assert_allclose(maps[:, :-1], np.broadcast_to(slope, (50, 3, 3)), atol=1e-4)


def test_interpolation_beats_the_nearest_entry(task, test_presses):
    errors = [
        np.hypot(*(method.fit(task)[0].predict(test_presses.charge_pC) - test_presses.contact)[:, :2].T).mean()
        for method in (NearestEntry(), InterpolatedTable())
    ]
    assert errors[1] < 0.3 * errors[0]
