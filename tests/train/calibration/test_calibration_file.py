"""calibration.json: unknowns without deviation, the next calibration with --from, and files that are wrong."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.train.calibration.conftest import presses_of, rig

from isocharge.common.errors import PressError
from isocharge.common.json_values import plain_values
from isocharge.serve import write_presses
from isocharge.train import calibrate, next_presses, read_earlier
from isocharge.train.calibration import result as result_module
from isocharge.train.calibration.calibration_file import film_table, read_film
from isocharge.train.calibration.folder import result_table
from isocharge.train.calibration.problem import Warming


@pytest.fixture(scope="module")
def bent(problem):
    """A calibration with an active discrepancy and no traces: charges with 3 % that no parameter describes."""
    _, presses = rig(problem, 20, seed=41)
    x, y, _ = presses.contact.T
    share = np.column_stack([np.sin(x / 4 + k) * np.cos(y / 5) for k in range(4)])
    result = calibrate(presses_of(problem, presses.contact, presses.charge_pC * np.exp(0.03 * share)), problem)
    assert result.posterior.imperfect
    assert (np.diag(result.posterior.joint) == 0.0).any()
    return result


@pytest.fixture(scope="module")
def table(bent):
    """What its calibration.json holds, with a change of temperature besides."""
    return json.loads(json.dumps(plain_values(result_table(bent)), allow_nan=False)) | {
        "temperature": {
            "at_C": 21.5,
            "pretension_per_K": {"value": -3e5, "std": 1e5},
            "correlations": [0.0] * len(bent.posterior.joint),
        }
    }


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("calibration")


@pytest.fixture(scope="module")
def read(folder, problem):
    """Read a table as the calibration.json of an earlier calibration."""

    def read_table(table):
        path = folder / "calibration.json"
        path.write_text(json.dumps(table))
        return read_film(path, problem)

    return read_table


def test_deviations_of_zero_survive_the_round_trip(bent, table, read):
    joint = bent.posterior.joint
    film = read(table)
    assert np.array_equal(np.diag(film.joint) == 0.0, np.diag(joint) == 0.0)
    np.testing.assert_allclose(film.joint, joint, atol=1e-5)  # correlations have six digits
    np.testing.assert_array_equal(film.coefficients, bent.posterior.coefficients)
    assert np.linalg.eigvalsh(film.joint)[0] > -1e-12


def test_null_beside_a_deviation_of_zero_is_read_as_older_versions_wrote_it(bent, table, read):
    without_variance = np.diag(bent.posterior.joint) == 0.0
    correlations = np.array(table["discrepancy"]["correlations"])
    correlations[np.add.outer(without_variance, without_variance)] = np.nan
    older = table | {"discrepancy": table["discrepancy"] | {"correlations": plain_values(correlations)}}
    np.testing.assert_array_equal(read(older).joint, read(table).joint)


def test_calibrate_from_a_film_with_a_discrepancy_and_no_traces(bent, problem, tmp_path, command):
    """The next presses begin where the last calibration ended."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "calibration.json").write_text(json.dumps(plain_values(result_table(bent))))
    write_presses(tmp_path / "presses.csv", bent.presses[:4])
    code, out, err = command(
        *("train", "calibrate", tmp_path / "presses.csv", "--sensor", "four-25um-biaxial"),
        *("--from", tmp_path / "mine", "--json"),
    )
    assert code == 0, err
    later = json.loads(out)
    expected = bent.posterior.drifted(problem.prior)
    expected_error = bent.sensitivity.contact_error(expected.joint)
    assert later["error_left_before"]["position_mm"] == pytest.approx(expected_error.position_mm, rel=0.02)
    assert later["error_left"]["position_mm"] < later["error_left_before"]["position_mm"]
    earlier = read_earlier(tmp_path / "mine", problem)
    np.testing.assert_allclose(earlier.joint, expected.joint, atol=1e-5)


def test_the_summary_plans_further_presses_once(bent, monkeypatch):
    """A plan of thirty presses takes seconds; the command, the card and the file all take the summary."""
    result = replace(bent)  # nothing is remembered yet
    plans = []
    monkeypatch.setattr(result_module, "next_presses", lambda *plan: plans.append(plan) or next_presses(*plan))
    assert result.summary == result.summary
    assert len(plans) == 1


@st.composite
def covariances(draw, count):
    """A covariance of the parameters and the change with temperature, singular or with unknowns without variance."""
    rank = draw(st.integers(1, count))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    root = rng.standard_normal((count, rank)) * np.geomspace(1e-3, 5.0, count)[:, None]
    root[rng.random(count) < draw(st.sampled_from([0.0, 0.3, 1.0]))] = 0.0
    return root @ root.T


@settings(deadline=None)
@given(data=st.data())
def test_any_covariance_survives_the_round_trip(data, bent, problem, read):
    prior = problem.prior
    covariance = data.draw(covariances(len(prior.names) + 1))
    warming = Warming(-0.3, float(np.sqrt(covariance[-1, -1])), 21.5, covariance[-1, :-1])
    posterior = replace(bent.posterior, covariance=covariance[:-1, :-1], probabilities={}, warming=warming)
    film = read(film_table(prior, posterior))
    std = np.sqrt(np.diag(covariance))
    tolerance = 1e-5 * np.outer(std, std)  # correlations have six digits
    assert (np.abs(film.covariance - covariance[:-1, :-1]) <= tolerance[:-1, :-1]).all()
    assert (np.abs(film.warming.covariance - covariance[-1, :-1]) <= tolerance[-1, :-1]).all()
    np.testing.assert_allclose(film.parameters, posterior.parameters, rtol=1e-12)


WRONG_FILES = {
    "a negative deviation": (("parameters", "young", "std"), -0.1, "parameters.young.std: expected a number from 0"),
    "a huge deviation": (("parameters", "young", "std"), 1e308, "parameters.young.std: expected at most 20"),
    "a huge value": (("parameters", "young", "value"), 1e308, "parameters.young.value: expected -0.5 to 0.5"),
    "a value of no film": (("parameters", "pretension", "value"), -1e5, "parameters.pretension.value: expected 0 to"),
    "a correlation of 2": (("correlations", 0, 1), 2, r"correlations\[0\]\[1\]: expected a number from -1"),
    "a diagonal of 0.5": (("correlations", 3, 3), 0.5, r"correlations\[3\]\[3\]: expected 1, the correlation"),
    "an asymmetric matrix": (("correlations", 0, 1), 0.123, "expected a symmetric matrix, got 0.123 in row 1"),
    "null": (("correlations", 0, 1), None, "got null"),
    "an unknown version": (("format_version",), 2, "format_version: expected one of 1, got 2"),
    "a number too few": (("discrepancy", "std"), [0.1], r"discrepancy.std: expected \d+ numbers"),
    "no coefficients": (("discrepancy", "coefficients"), [], r"expected \d+ numbers, got 0"),
    "a huge coefficient": (("discrepancy", "coefficients", 0), -1e308, r"coefficients\[0\]: expected at most 30"),
    "other deviations": (("discrepancy", "std", 0), 3.0, "expected the standard deviations of the parameters"),
    "a row too few": (("discrepancy", "correlations"), [[1.0]], r"expected \d+ rows of as many numbers"),
    "a frozen film": (("temperature", "at_C"), -300.0, "at_C: expected a number from -100 to 200"),
    "a huge change": (("temperature", "pretension_per_K", "value"), 1e308, "expected at most 4e.07 Pa/K"),
    "too few correlations": (("temperature", "correlations"), [0.1], r"correlations: expected \d+ numbers"),
    "too many correlations": (("temperature", "correlations", 0), -1.5, r"correlations\[0\]: expected a number from"),
}


@pytest.mark.parametrize("name", WRONG_FILES)
def test_a_wrong_calibration_file_is_refused_with_the_place_and_the_value(name, table, read):
    place, value, message = WRONG_FILES[name]
    with pytest.raises(PressError, match=message):
        read(changed(table, place, value))


def test_correlations_that_no_unknowns_have_together_are_refused(table, read):
    """A is as B, B as C, and A the opposite of C; each number alone is a correlation."""
    plain = table | {"discrepancy": None, "temperature": None}
    correlations = np.eye(len(plain["correlations"]))
    correlations[:3, :3] = [[1.0, 0.9, -0.9], [0.9, 1.0, 0.9], [-0.9, 0.9, 1.0]]
    with pytest.raises(PressError, match=r"expected a positive semidefinite matrix, got one with the eigenvalue -0\.8"):
        read(plain | {"correlations": correlations.tolist()})
    with_itself = [1.0, 1.0, *[0.0] * (len(correlations) - 2)]
    uncorrelated = plain | {"correlations": np.eye(len(correlations)).tolist()}
    with pytest.raises(PressError, match="expected a positive semidefinite matrix"):
        read(uncorrelated | {"temperature": table["temperature"] | {"correlations": with_itself}})


def changed(table, place, value):
    """A copy of a table with another value in one place."""
    key, *rest = place
    inner = changed(table[key], rest, value) if rest else value
    copy = dict(table) if isinstance(table, dict) else list(table)
    copy[key] = inner
    return copy


def draw_place(data, table, place=()):
    """The place of a number, a list or a table within a table."""
    if place and not (isinstance(table, dict | list) and table and data.draw(st.integers(0, 9))):
        return place
    keys = sorted(table) if isinstance(table, dict) else range(len(table))
    key = data.draw(st.sampled_from(keys))
    return draw_place(data, table[key], (*place, key))


JUNK = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.sampled_from([0.0, -0.0, 2.0, 5e-324, 1e-300, 1e15, 1e154, 1e155, 1e308, -1e308, 1 << 70]),
    st.text(max_size=5),
    st.lists(st.floats(-1.0, 1.0), max_size=15),
    st.dictionaries(st.text(max_size=5), st.floats(), max_size=3),
)


@settings(deadline=None, max_examples=60)
@given(data=st.data())
def test_any_change_of_a_calibration_file_is_refused_or_gives_a_film(data, table, read, problem):
    """A film that is accepted is finite, and has a covariance that can be one."""
    used = {key: table[key] for key in ("format_version", "sensor", "parameters", "correlations", "temperature")}
    plain = used | {"temperature": used["temperature"] | {"correlations": [0.0] * len(used["parameters"])}}
    base = data.draw(st.sampled_from([plain, used | {"discrepancy": table["discrepancy"]}]))
    for _ in range(data.draw(st.integers(1, 2))):
        base = changed(base, draw_place(data, base), data.draw(JUNK))
    try:
        film = read(base)
    except PressError as refusal:
        message = str(refusal)
    else:
        message = ""
    if message:
        assert "calibration.json: " in message
        assert len(message) < 2000
        return
    assert np.isfinite(film.unknowns).all()
    assert np.isfinite(film.unknown_covariance).all()
    np.linalg.cholesky(film.drifted(problem.prior).unknown_covariance)
    if film.warming is not None:
        assert np.isfinite([film.warming.MPa_per_K, film.warming.std, film.warming.at_C]).all()
