"""The exported graph against the network it was made from, and against the definitions of its outputs."""

import copy

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from isocharge.common.errors import TrainingError
from isocharge.simulate import noise_model
from isocharge.train.model_release.export import check_graph, export_onnx
from isocharge.train.training import correlation
from isocharge.train.training.correlation import with_correlation
from isocharge.train.training.network import fold_network

REFERENCE = noise_model("reference")
ABSURD = {
    "negative": lambda charge: -charge,
    "zero": lambda charge: 0.0 * charge,
    "tiny": lambda charge: 1e-30 * charge,
    "huge": lambda charge: 1e30 * charge,
}
ODD = {
    "clean": lambda charge: charge,
    "ten times": lambda charge: 10.0 * charge,
    "a tenth": lambda charge: 0.1 * charge,
    "dead electrode": lambda charge: charge * [0.0, 1.0, 1.0],
    "wrong gain": lambda charge: charge * [1.0, 1.2, 1.0],
    **ABSURD,
}


@pytest.fixture(scope="module")
def held(trained):
    return trained.split.held


@pytest.fixture(scope="module")
def graph(trained):
    return export_onnx(turned(trained.network, trained), {"note": "kept"})


def turned(network, trained):
    """The network, folded, with correlations."""
    return with_correlation(fold_network(network), trained.split.train, REFERENCE, 0)


@pytest.fixture(scope="module")
def session(graph):
    return onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])


def answers(session, charge):
    return session.run(["contact", "contact_std", "misfit"], {"charge_pC": charge.astype(np.float32)})


FLOORS = ([1.0, 1.0, 0.1], [1.0, 1.0, 0.1], [1.0])
"""Below these, mm, mm, N and standard deviations, differences count absolutely."""

CLOSE, CLOSE_MISFIT = 1e-5, 1e-4
"""Relative differences that float32 may make on charges that a film gives."""


def apart(answers, expected):
    """Largest relative difference of each output."""
    return [
        float(np.max(np.abs(a - b) / np.maximum(np.abs(b), floor)))
        for a, b, floor in zip(answers, expected, FLOORS, strict=False)
    ]


def by_torch(trained, charge):
    """In double precision, from the charges that the graph gets."""
    with torch.no_grad():
        double = copy.deepcopy(trained.network).double()
        return [tensor.numpy() for tensor in double(torch.tensor(charge.astype(np.float32)).double())]


def test_the_graph_answers_as_the_network_does_on_ten_thousand_presses(trained, held, session):
    charge = held[np.arange(10_000) % len(held)].noisy(REFERENCE, seed=0)
    contact, std, misfit = apart(answers(session, charge), by_torch(trained, charge))
    assert contact < CLOSE
    assert std < CLOSE
    assert misfit < CLOSE_MISFIT


@pytest.mark.parametrize("case", ODD)
def test_the_graph_answers_as_the_network_does_on_odd_charges(trained, held, session, case):
    charge = ODD[case](held.charge)
    found = answers(session, charge)
    assert max(apart(found, by_torch(trained, charge))) < 10.0 * CLOSE
    assert all(np.isfinite(output).all() for output in found)
    assert case not in ABSURD or found[2].min() > 50.0


def test_a_network_that_runs_off_the_numbers_is_not_released(trained, held, monkeypatch):
    monkeypatch.setattr(correlation, "EXAMPLES", 1_000)  # errors that are nonsense have no correlations to find
    network = copy.deepcopy(trained.network)
    with torch.no_grad():
        network.contact.skip.weight *= 1e3
    exact = turned(network, trained)
    with pytest.raises(TrainingError, match=r"answers contact = .* expected finite numbers for any charges"):
        check_graph(export_onnx(exact, {}), exact.outputs, held, REFERENCE)


def test_file_and_network_may_differ_by_a_thousandth_of_what_charges_tell(trained, held, graph):
    exact = turned(trained.network, trained)

    def beside(deviations):
        def outputs(charge):
            contact, std, *others = exact.outputs(charge)
            return contact + deviations * std, std, *others

        return outputs

    check_graph(graph, beside(8e-4), held, REFERENCE)
    with pytest.raises(
        TrainingError, match=r"on contact: expected at most 1e-05 for 99\.9% of the charges and 0\.0001 for all"
    ):
        check_graph(graph, beside(2e-3), held, REFERENCE)


def test_the_file_is_plain_onnx_that_another_runtime_computes(held, graph, session):
    """onnx's own reference implementation, in plain NumPy."""
    from onnx.reference import ReferenceEvaluator

    model = onnx.load_from_string(graph)
    onnx.checker.check_model(model, full_check=True)
    assert {entry.key: entry.value for entry in model.metadata_props} == {"note": "kept"}
    assert {entry.domain for entry in model.opset_import} == {""}
    charge = held.charge[:50].astype(np.float32)
    reference = ReferenceEvaluator(model).run(["contact", "contact_std", "misfit"], {"charge_pC": charge})
    contact, std, misfit = answers(session, charge)
    assert max(apart((contact, std), reference[:2])) < CLOSE
    assert np.all(np.abs(misfit - reference[2]) <= CLOSE_MISFIT * np.maximum(misfit, 1.0))
