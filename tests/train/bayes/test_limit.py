"""The Bayes limit and the cache that keeps it."""

import json

import numpy as np
import pytest

from isocharge.common.errors import ChargeError, InputError
from isocharge.simulate import ChargeSpline, Circle, noise_model
from isocharge.train import BayesLimit, Scene, bayes_estimate, bayes_limit
from isocharge.train.bayes import cache as cache_module
from isocharge.train.bayes.cache import cache_folder, cached


@pytest.fixture(scope="module")
def charges(film):
    """The map as splines, made once."""
    return ChargeSpline.of(film)


@pytest.fixture
def scene(sensor):
    return Scene(sensor, Circle(1e-3))


def test_the_limit_is_what_the_estimates_give(scene, film):
    limit = bayes_limit(scene, 60, seed=5, forward_map=film)
    assert 0.05 < limit.position_median_mm < limit.position_rms_mm < 0.4
    assert limit.presses == 60
    assert limit.expected_position_rms_mm == pytest.approx(limit.position_rms_mm, rel=0.5)
    assert limit.force_rms_percent < 2.0


def test_it_is_kept(scene, film):
    first = bayes_limit(scene, 20, forward_map=film)
    told = []
    assert bayes_limit(scene, 20, forward_map=film, progress=lambda *_: told.append(1)) == first
    assert not told
    assert bayes_limit(scene, 21, forward_map=film, progress=lambda *_: told.append(1)) != first
    assert told


def test_errors_by_hand():
    truth = np.array([[0.0, 0.0, 1.0], [1.0, 1.0, 2.0]])
    limit = BayesLimit.of(truth + np.array([[0.3, 0.4, 0.01], [0.0, 0.0, 0.0]]), np.ones((2, 3)), truth)
    assert limit.position_rms_mm == pytest.approx(0.5 / np.sqrt(2.0))
    assert limit.position_median_mm == pytest.approx(0.25)
    assert limit.force_rms_percent == pytest.approx(1.0 / np.sqrt(2.0))
    assert limit.expected_position_rms_mm == pytest.approx(np.sqrt(2.0))


def test_estimates_are_in_mm_and_newtons(scene, film, charges):
    charge = 1e12 * film.forward(np.array([3e-3]), np.array([-2e-3]), np.array([1.5]))
    contact, std = bayes_estimate(scene, charge, forward_map=charges)
    assert contact[0] == pytest.approx([3.0, -2.0, 1.5], rel=0.01)
    assert (std[0] < [0.1, 0.1, 0.01]).all()


def test_what_does_not_fit_is_refused(scene, charges, sensor):
    with pytest.raises(ChargeError, match="got none"):
        bayes_estimate(scene, np.empty((0, 3)), forward_map=charges)
    with pytest.raises(InputError, match="expected the scene's"):
        bayes_estimate(Scene(sensor, Circle(1e-3), force_range_N=(0.1, 1.0)), np.ones((1, 3)), forward_map=charges)
    with pytest.raises(InputError, match="noise"):
        bayes_estimate(Scene(sensor, Circle(1e-3), noise=noise_model("clean")), np.ones((1, 3)), forward_map=charges)


class Counted:
    """A computation that counts itself."""

    def __init__(self):
        self.calls = 0

    def __call__(self):
        self.calls += 1
        return {"value": 1.5, "all": [1, 2]}


def only_file():
    (path,) = cache_folder().glob("*.json")
    return path


def test_a_result_is_computed_once():
    count = Counted()
    results = [cached("thing", {"a": 1}, count) for _ in range(3)]
    assert results == [{"value": 1.5, "all": [1, 2]}] * 3
    assert count.calls == 1


def test_another_key_is_another_result():
    count = Counted()
    for key in ({"a": 1}, {"a": 2}, {"a": 1, "b": 0}, {"a": 1}):
        cached("thing", key, count)
    assert count.calls == 3


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: text.replace("1.5", "2.5"),
        lambda text: text.replace('"a":1', '"a":7'),
        lambda _: "[]",
        lambda _: "",
    ],
    ids=["cut short", "a digit", "another key", "something else", "empty"],
)
def test_a_damaged_file_is_computed_anew(damage):
    count = Counted()
    cached("thing", {"a": 1}, count)
    path = only_file()
    path.write_text(damage(path.read_text()))
    assert cached("thing", {"a": 1}, count)["value"] == 1.5
    assert count.calls == 2
    assert json.loads(path.read_text())["result"]["value"] == 1.5
    assert cached("thing", {"a": 1}, count)["value"] == 1.5
    assert count.calls == 2


def test_where_nothing_can_be_kept_it_still_answers(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ISOCHARGE_CACHE", str(tmp_path / "file" / "below"))
    with pytest.warns(UserWarning, match="cannot be stored"):
        assert cached("thing", {"a": 1}, Counted())["value"] == 1.5


def test_where_it_is_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("ISOCHARGE_CACHE", str(tmp_path / "own"))
    assert cache_folder() == tmp_path / "own"
    monkeypatch.delenv("ISOCHARGE_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "shared"))
    assert cache_folder() == tmp_path / "shared" / "isocharge"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(cache_module.Path, "home", lambda: tmp_path)
    assert cache_folder() == tmp_path / ".cache" / "isocharge"
