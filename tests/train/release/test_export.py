"""The exported graph against the network it was made from, and against the definitions of its outputs."""

import copy

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.errors import TrainingError
from isocharge.simulate import noise_model
from isocharge.train.data.noise import noisy_charges
from isocharge.train.release.export import export_onnx
from isocharge.train.release.folding import fold_network
from isocharge.train.release.graph_check import _check_finite

CASES = {
    "clean": lambda charge: charge,
    "ten times": lambda charge: 10.0 * charge,
    "a tenth": lambda charge: 0.1 * charge,
    "dead electrode": lambda charge: charge * [0.0, 1.0, 1.0],
    "wrong gain": lambda charge: charge * [1.0, 1.2, 1.0],
    "negative": lambda charge: -charge,
    "zero": lambda charge: 0.0 * charge,
    "tiny": lambda charge: 1e-30 * charge,
    "huge": lambda charge: 1e30 * charge,
}


@pytest.fixture(scope="module")
def graph(fit):
    return export_onnx(fold_network(fit.network), {"note": "kept"})


@pytest.fixture(scope="module")
def session(graph):
    return onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])


def answers(session, charge):
    return session.run(["contact", "contact_std", "misfit"], {"charge_pC": charge.astype(np.float32)})


FLOORS = ([1.0, 1.0, 0.1], [1.0, 1.0, 0.1], [1.0])
"""Below these, mm, mm, N and standard deviations, differences count absolutely."""

CLOSE, CLOSE_MISFIT = 1e-5, 1e-4
"""Relative differences that float32 may make on charges that a film gives."""


def apart(answers, wanted):
    """Largest relative difference of each output."""
    return [
        float(np.max(np.abs(a - b) / np.maximum(np.abs(b), floor)))
        for a, b, floor in zip(answers, wanted, FLOORS, strict=False)
    ]


def by_torch(fit, charge):
    """In double precision, from the charges that the graph gets."""
    with torch.no_grad():
        double = copy.deepcopy(fit.network).double()
        return [tensor.numpy() for tensor in double(torch.tensor(charge.astype(np.float32)).double())]


def test_the_graph_answers_as_the_network_does_on_ten_thousand_presses(fit, session):
    rows = np.arange(10_000) % len(fit.held)
    charge = noisy_charges(fit.held[rows], noise_model("reference"), seed=0)
    contact, std, misfit = apart(answers(session, charge), by_torch(fit, charge))
    assert contact < CLOSE
    assert std < CLOSE
    assert misfit < CLOSE_MISFIT


@pytest.mark.parametrize("case", CASES)
def test_the_graph_answers_as_the_network_does_on_odd_charges(fit, session, case):
    charge = CASES[case](fit.held.charge_pC)
    assert max(apart(answers(session, charge), by_torch(fit, charge))) < 10.0 * CLOSE


CHARGE = st.one_of(st.floats(width=32, allow_nan=False, allow_infinity=False), st.floats(0.0, 5e3, width=32))


@settings(derandomize=True, max_examples=200)
@given(st.lists(CHARGE, min_size=3, max_size=3))
def test_any_finite_charges_have_a_finite_answer_near_the_networks(fit, session, charge):
    charge = np.array([charge], dtype=np.float32)
    found = answers(session, charge)
    assert all(np.isfinite(output).all() for output in found)
    assert min(found[1].min(), found[2].min()) >= 0.0
    assert max(apart(found, by_torch(fit, charge))) < 1e-3  # off the features' range lengths of large numbers cancel


@pytest.mark.parametrize("case", CASES)
def test_every_answer_is_finite(fit, session, case):
    for output in answers(session, CASES[case](fit.held.charge_pC)):
        assert np.isfinite(output).all()


def test_a_network_that_runs_off_the_numbers_is_not_released(fit, graph):
    _check_finite(graph, 3)
    steep = copy.deepcopy(fit.network)
    with torch.no_grad():
        steep.contact.skip.weight *= 1e3
    with pytest.raises(TrainingError, match=r"answers contact = .* expected finite numbers for any charges"):
        _check_finite(export_onnx(fold_network(steep), {}), 3)


@pytest.mark.parametrize("case", ["negative", "zero", "tiny", "huge"])
def test_absurd_charges_have_a_large_misfit(fit, session, case):
    assert answers(session, CASES[case](fit.held.charge_pC))[2].min() > 50.0


def test_a_batch_answers_as_its_rows_do(fit, session):
    charge = noisy_charges(fit.held, noise_model("reference"), seed=0)[:20]
    together = answers(session, charge)
    for row in range(len(charge)):
        alone = answers(session, charge[row : row + 1])
        for one, all_of_them in zip(alone, together, strict=True):
            assert np.allclose(one[0], all_of_them[row], rtol=1e-5, atol=1e-2)  # sums in another order


def test_the_file_is_plain_onnx_with_its_properties(graph):
    model = onnx.load_from_string(graph)
    onnx.checker.check_model(model, full_check=True)
    assert {entry.key: entry.value for entry in model.metadata_props} == {"note": "kept"}
    assert {entry.domain for entry in model.opset_import} == {""}
    assert [output.name for output in model.graph.output] == ["contact", "contact_std", "misfit"]


def test_another_runtime_agrees(fit, graph, session):
    """onnx's own reference implementation, in plain NumPy."""
    from onnx.reference import ReferenceEvaluator

    charge = fit.held.charge_pC[:50].astype(np.float32)
    reference = ReferenceEvaluator(onnx.load_from_string(graph)).run(None, {"charge_pC": charge})
    contact, std, misfit = answers(session, charge)
    assert max(apart((contact, std), reference[:2])) < CLOSE
    assert np.all(np.abs(misfit - reference[2]) <= CLOSE_MISFIT * np.maximum(misfit, 1.0))
