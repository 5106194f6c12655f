"""Predictions equal those of a plain onnxruntime session, and arguments that are no charges are refused."""

import copy
import math
import pickle
import re
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from decimal import Decimal

import numpy as np
import onnxruntime as ort
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import ChargeError
from isocharge.serve import Contact, Contacts, Predictor

PRESSES = st.lists(st.floats(0.0, 5000.0, width=32), min_size=3, max_size=3).filter(lambda q: sum(q) > 1.0)


@pytest.fixture(scope="module")
def plain_session(models):
    """A plain onnxruntime session of the same model."""
    return ort.InferenceSession(str(models / "linear/1/model.onnx"), providers=["CPUExecutionProvider"])


def plain_outputs(session, charge_pC):
    """Compute the values of a `Contact`, whose order is fixed because other programs read them by position."""
    names = ["contact", "contact_std", "misfit", "contact_correlation"]
    return np.concatenate(session.run(names, {"charge_pC": np.atleast_2d(np.float32(charge_pC))}), axis=1)


@settings(derandomize=True)
@given(PRESSES)
def test_predict_equals_a_plain_session(plain_session, predictor, charge_pC):
    expected = plain_outputs(plain_session, charge_pC)[0]
    assert predictor.predict(charge_pC) == pytest.approx(expected, rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    "kind",
    [
        list,
        tuple,
        np.float32,
        np.float64,
        np.int64,
        lambda q: [Decimal(v) for v in q],
    ],
)
def test_predict_takes_any_kind_of_numbers(predictor, kind):
    assert predictor.predict(kind([100, 100, 100])) == predictor.predict([100.0, 100.0, 100.0])


@pytest.mark.parametrize(
    ("charge_pC", "message"),
    [
        ([1.0, 2.0, 3.0, 4.0], r"expected 3 charges \('A', 'B', 'C'\), got an array of shape \(4,\)"),
        (5.0, r"got an array of shape \(\)"),
        ({"A": 1.0, "B": 2.0, "C": 3.0}, "got {'A': 1.0"),
        ([1.0, None, 3.0], "as numbers"),
        ([1.0, math.nan, 3.0], r"expected finite float32 charges \(pC\), got for electrode 'B' \(nan\)"),
        ([math.inf, 0.0, -math.inf], r"'A' \(inf\), 'C' \(-inf\)"),
        (np.ma.array([1.0, 2.0, 3.0], mask=[False, True, False]), "as numbers"),
        (np.zeros((2, 4)), r"rows of 3 charges \('A', 'B', 'C'\), shape \(n, 3\), got an array of shape \(2, 4\)"),
        ([[1.0, 2.0, 3.0], [1.0, 2.0]], "in each row"),
        ([[1.0, 2.0, 3.0], [1.0, math.nan, math.inf]], r"in row 1 .* for electrode 'B' \(nan\), 'C' \(inf\)"),
    ],
)
def test_predict_and_predict_batch_refuse_wrong_charges(predictor, charge_pC, message):
    predict = predictor.predict_batch if "row" in message else predictor.predict
    with pytest.raises(ChargeError, match=message):
        predict(charge_pC)


@pytest.mark.parametrize("gap", [1, 2])
def test_predict_into_fills_an_array(film, predictor, plain_session, gap):
    charges, out = np.zeros(3 * gap, np.float32)[::gap], np.full(10 * gap, -1.0, np.float32)[::gap]
    for row in film.golden_pC():
        charges[:] = row
        predictor.predict_into(charges, out)
        assert out == pytest.approx(plain_outputs(plain_session, row)[0], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize(
    ("charge_pC", "out", "message"),
    [
        (np.ones(3), np.zeros(10, np.float32), r"got array\(\[1\., 1\., 1\.\]\) and array\(\[.*dtype=float32\)"),
        (
            np.ones(4, np.float32),
            np.zeros(10, np.float32),
            r"\('A', 'B', 'C'\) .* got array\(\[1\., 1\., 1\., 1\.\], ",
        ),
        (np.ones(3, np.float32), np.zeros(10), r"and array\(\[0\., .* 0\.\]\) "),
        (np.ones(3, np.float32), np.broadcast_to(np.float32(0.0), 10), "read-only"),
    ],
)
def test_predict_into_refuses_arrays_of_a_wrong_type_or_shape(predictor, charge_pC, out, message):
    with pytest.raises(ChargeError, match=message):
        predictor.predict_into(charge_pC, out)
    assert not np.any(out)


def test_predict_into_allocates_no_array(predictor):
    charges, out = np.full(3, 100.0, np.float32), np.zeros(10, np.float32)
    predictor.predict_into(charges, out)
    tracemalloc.start()
    for _ in range(10_000):
        predictor.predict_into(charges, out)
    grown_bytes, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # One array for each call would be 1 MB. onnxruntime holds up to 10 kB after other tests, however many calls follow.
    assert grown_bytes < 20_000


def test_warning_about_an_implausible_contact_is_logged_once(models, film, caplog):
    predictor = Predictor("linear", models=models)
    presses = film.charge_pC([0.0, 0.0], [0.0, 0.0], [1.0, 5.9])
    assert [predictor.flags(predictor.predict(charge_pC)) for charge_pC in presses] == [(), ("outside",)]
    assert caplog.messages == []
    assert predictor.flags(predictor.predict([9e9, 9e9, 9e9])) == ("outside", "beyond")
    predictor.predict([9e9, 9e9, 9e9])
    (message,) = caplog.messages
    assert message.startswith("linear/1: the charges [9000000000.0, 9000000000.0, 9000000000.0] pC on A B C ")
    assert "--check-electrodes` whether wires are swapped" in message
    assert re.search(r"force_N=1\.125e\+07 .* cannot be a measurement", message)


def test_order_of_the_fields_of_a_contact_is_fixed():
    """Other programs, such as exported C code, read the values by their positions."""
    names = ("x_mm", "y_mm", "force_N", "x_std_mm", "y_std_mm", "force_std_N", "misfit")
    assert Contact._fields == Contacts._fields == (*names, "xy_correlation", "xF_correlation", "yF_correlation")


def test_predictor_answers_rightly_in_several_threads(film, predictor):
    """One predictor is used by four threads at once, each with its own press."""
    charges = film.charge_pC(np.linspace(-3.0, 3.0, 4), np.zeros(4), np.full(4, 0.5)).tolist()
    expected = [predictor.predict(row) for row in charges]

    def wrong_answers(number):
        return sum(predictor.predict(charges[number]) != expected[number] for _ in range(300))

    with ThreadPoolExecutor(4) as threads:
        assert list(threads.map(wrong_answers, range(4))) == [0] * 4


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_predictor_can_be_copied_and_pickled(film, predictor, copied, tmp_path, monkeypatch):
    """Also after the program has changed its working directory, from which the model was loaded."""
    charges = film.charge_pC([1.0], [2.0], [0.5])[0]
    monkeypatch.chdir(predictor.folder.parent)
    relative = Predictor(predictor.folder.name)
    monkeypatch.chdir(tmp_path)
    other = copied(relative)
    assert other.predict(charges) == predictor.predict(charges)
    assert other._single_inference is not predictor._single_inference
