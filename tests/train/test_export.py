"""The exported graph against the network it was made from, and against the definitions of its outputs."""

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from isocharge.simulate import noise_model
from isocharge.train.evaluate import noisy_charges
from isocharge.train.export import export_onnx

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
    return export_onnx(fit.network, {"note": "kept"})


@pytest.fixture(scope="module")
def session(graph):
    return onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])


def answers(session, charge):
    return session.run(["contact", "contact_std", "misfit"], {"charge_pC": charge.astype(np.float32)})


@pytest.mark.parametrize("case", CASES)
def test_the_graph_answers_as_the_network_does(fit, session, case):
    charge = CASES[case](fit.held.charge_pC).astype(np.float32)
    with torch.no_grad():
        wanted = [tensor.numpy() for tensor in fit.network(torch.tensor(charge))]
    contact, std, misfit = answers(session, charge)
    floor = np.array([1.0, 1.0, 0.1])
    assert np.all(np.abs(contact - wanted[0]) <= 2e-5 * np.maximum(np.abs(wanted[0]), floor))
    assert np.all(np.abs(std - wanted[1]) <= 2e-5 * np.maximum(np.abs(wanted[1]), floor))
    assert np.all(np.abs(misfit - wanted[2]) <= 0.02 + 1e-4 * wanted[2])


@pytest.mark.parametrize("case", CASES)
def test_every_answer_is_finite(fit, session, case):
    for output in answers(session, CASES[case](fit.held.charge_pC)):
        assert np.isfinite(output).all()


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
    floor = np.array([1.0, 1.0, 0.1])
    assert np.all(np.abs(contact - reference[0]) <= 1e-5 * np.maximum(np.abs(contact), floor))
    assert np.all(np.abs(std - reference[1]) <= 1e-5 * np.maximum(np.abs(std), floor))
    assert np.all(np.abs(misfit - reference[2]) <= 0.02)
