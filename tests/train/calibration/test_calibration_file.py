"""Tests of calibration.json: round trips, a further calibration with --from, and faulty files."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import PressError
from isocharge.common.json_values import plain_values
from isocharge.serve import write_presses
from isocharge.train import next_presses, read_earlier
from isocharge.train.calibration import result as result_module
from isocharge.train.calibration.calibration_file import film_table, read_film
from isocharge.train.calibration.folder import result_table
from isocharge.train.calibration.problem import Warming

pytestmark = pytest.mark.usefixtures("no_closed_backs")


@pytest.fixture(scope="module")
def imperfect(film_with_discrepancy):
    """A calibration by presses whose charges have errors of 3 % that no parameter describes.

    The result has a discrepancy and no traces, so that some unknowns have no variance.
    """
    _, result = film_with_discrepancy
    assert result.posterior.imperfect
    assert (np.diag(result.posterior.joint) == 0.0).any()
    return result


@pytest.fixture(scope="module")
def table(imperfect):
    """The content of calibration.json of this calibration, with an added change with temperature."""
    temperature = {
        "at_C": 21.5,
        "pretension_per_K": {"value": -3e5, "std": 1e5},
        "correlations": [0.0] * len(imperfect.posterior.joint),
    }
    table = json.loads(json.dumps(plain_values(result_table(imperfect)), allow_nan=False))
    return table | {"temperature": temperature}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("calibration")


@pytest.fixture(scope="module")
def read(folder, problem):
    """A function that reads a table as the calibration.json of an earlier calibration."""

    def read_table(table):
        path = folder / "calibration.json"
        path.write_text(json.dumps(table))
        return read_film(path, problem)

    return read_table


def test_standard_deviations_of_zero_are_read_back(imperfect, table, read):
    joint = imperfect.posterior.joint
    film = read(table)
    assert np.array_equal(np.diag(film.joint) == 0.0, np.diag(joint) == 0.0)
    np.testing.assert_allclose(film.joint, joint, atol=1e-5)  # correlations have six digits
    np.testing.assert_array_equal(film.coefficients, imperfect.posterior.coefficients)
    assert np.linalg.eigvalsh(film.joint)[0] > -1e-12


def test_null_as_correlation_of_an_unknown_without_variance_is_read(imperfect, table, read):
    """Earlier versions wrote null there."""
    has_no_variance = np.diag(imperfect.posterior.joint) == 0.0
    correlations = np.array(table["discrepancy"]["correlations"])
    correlations[has_no_variance[:, None] | has_no_variance] = np.nan
    older = table | {"discrepancy": table["discrepancy"] | {"correlations": plain_values(correlations)}}
    np.testing.assert_array_equal(read(older).joint, read(table).joint)


def test_calibrate_continues_from_a_film_with_a_discrepancy(imperfect, problem, tmp_path, command):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "calibration.json").write_text(json.dumps(plain_values(result_table(imperfect))))
    write_presses(tmp_path / "presses.csv", imperfect.presses[:4])
    code, out, err = command(
        *("train", "calibrate", tmp_path / "presses.csv", "--sensor", "four-25um-biaxial"),
        *("--from", tmp_path / "mine", "--json"),
    )
    assert code == 0, err
    later = json.loads(out)
    expected = imperfect.posterior.drifted(problem.prior)
    expected_error = imperfect.sensitivity.contact_error(expected.joint)
    assert later["error_left_before"]["position_mm"] == pytest.approx(expected_error.position_mm, rel=0.02)
    assert later["error_left"]["position_mm"] < later["error_left_before"]["position_mm"]
    earlier = read_earlier(tmp_path / "mine", problem)
    np.testing.assert_allclose(earlier.joint, expected.joint, atol=1e-5)


def test_summary_plans_further_presses_only_once(imperfect, monkeypatch):
    """Planning thirty presses takes seconds, and the summary is used by the command, the card and the file."""
    result = replace(imperfect)  # a copy without cached values
    planned = []

    def count_plans(*arguments):
        planned.append(arguments)
        return next_presses(*arguments)

    monkeypatch.setattr(result_module, "next_presses", count_plans)
    assert result.summary == result.summary
    assert len(planned) == 1


@st.composite
def covariances(draw, count):
    """Draw a covariance of `count` unknowns, which may be singular, and in which unknowns may have no variance."""
    rank = draw(st.integers(1, count))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    root = rng.standard_normal((count, rank)) * np.geomspace(1e-3, 5.0, count)[:, None]
    share_without_variance = draw(st.sampled_from([0.0, 0.3, 1.0]))
    root[rng.random(count) < share_without_variance] = 0.0
    return root @ root.T


@settings(deadline=None)
@given(data=st.data())
def test_any_covariance_is_read_back(data, imperfect, problem, read):
    """The last unknown of the covariance is the change of the pretension with temperature."""
    prior = problem.prior
    n_parameter = len(prior.names)
    joint = data.draw(covariances(n_parameter + 1))
    covariance = joint[:n_parameter, :n_parameter]
    warming_covariance = joint[n_parameter, :n_parameter]
    warming_std = float(np.sqrt(joint[n_parameter, n_parameter]))
    warming = Warming(-0.3, warming_std, 21.5, warming_covariance)
    posterior = replace(imperfect.posterior, covariance=covariance, probabilities={}, warming=warming)
    film = read(film_table(prior, posterior))
    std = np.sqrt(np.diag(covariance))
    relative_tolerance = 1e-5  # correlations have six digits
    assert (np.abs(film.covariance - covariance) <= relative_tolerance * np.outer(std, std)).all()
    assert (np.abs(film.warming.covariance - warming_covariance) <= relative_tolerance * warming_std * std).all()
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


"""Path of keys to a value in the file, the faulty value, and the message that names the fault."""


@pytest.mark.parametrize("name", WRONG_FILES)
def test_faulty_calibration_file_is_refused_with_the_key_and_the_value(name, table, read):
    keys, value, message = WRONG_FILES[name]
    with pytest.raises(PressError, match=message):
        read(with_value(table, keys, value))


def test_correlations_that_contradict_each_other_are_refused(table, read):
    """The first unknown is correlated with the second, and the second with the third, but not the first with the third.

    Each number alone is a valid correlation.
    """
    plain = table | {"discrepancy": None, "temperature": None}
    correlations = np.eye(len(plain["correlations"]))
    correlations[:3, :3] = [[1.0, 0.9, -0.9], [0.9, 1.0, 0.9], [-0.9, 0.9, 1.0]]
    with pytest.raises(PressError, match=r"expected a positive semidefinite matrix, got one with the eigenvalue -0\.8"):
        read(plain | {"correlations": correlations.tolist()})


def test_change_with_temperature_cannot_equal_two_uncorrelated_parameters(table, read):
    count = len(table["correlations"])
    uncorrelated = table | {"discrepancy": None, "correlations": np.eye(count).tolist()}
    warming_correlations = [1.0, 1.0, *[0.0] * (count - 2)]
    with pytest.raises(PressError, match="expected a positive semidefinite matrix"):
        read(uncorrelated | {"temperature": table["temperature"] | {"correlations": warming_correlations}})


def with_value(table, keys, value):
    """Return a copy of nested dictionaries and lists with another value at a path of keys."""
    key, *inner_keys = keys
    copy = dict(table) if isinstance(table, dict) else list(table)
    copy[key] = with_value(table[key], inner_keys, value) if inner_keys else value
    return copy


def draw_keys(data, table, keys=()):
    """Draw the path of keys to a value, a list or a dictionary within nested dictionaries and lists."""
    is_container = isinstance(table, dict | list) and len(table) > 0
    goes_deeper = not keys or (is_container and data.draw(st.integers(0, 9)) > 0)
    if not goes_deeper:
        return keys
    choices = sorted(table) if isinstance(table, dict) else range(len(table))
    key = data.draw(st.sampled_from(choices))
    return draw_keys(data, table[key], (*keys, key))


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
def test_any_change_of_a_calibration_file_is_refused_or_gives_a_valid_film(data, table, read, problem):
    """A valid film has finite parameters and a positive definite covariance after a drift."""
    read_keys = ("format_version", "sensor", "parameters", "correlations", "temperature")
    with_temperature = {key: table[key] for key in read_keys}
    no_correlations = [0.0] * len(table["parameters"])
    plain = with_temperature | {"temperature": table["temperature"] | {"correlations": no_correlations}}
    with_discrepancy = with_temperature | {"discrepancy": table["discrepancy"]}
    changed = data.draw(st.sampled_from([plain, with_discrepancy]))
    for _ in range(data.draw(st.integers(1, 2))):
        changed = with_value(changed, draw_keys(data, changed), data.draw(JUNK))
    refusal = None
    try:
        film = read(changed)
    except PressError as error:
        refusal = str(error)
    if refusal is not None:
        assert "calibration.json: " in refusal
        assert len(refusal) < 2000
        return
    assert np.isfinite(film.unknowns).all()
    assert np.isfinite(film.unknown_covariance).all()
    np.linalg.cholesky(film.drifted(problem.prior).unknown_covariance)
    if film.warming is not None:
        assert np.isfinite([film.warming.MPa_per_K, film.warming.std, film.warming.at_C]).all()
