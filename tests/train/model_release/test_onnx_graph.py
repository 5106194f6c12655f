"""The exported graph against the network from which it was written; graphs that the reader refuses."""

import copy

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import numpy_helper
from tests.train.random_networks import random_network

from isocharge.common.errors import ModelError, TrainingError
from isocharge.serve import find_model
from isocharge.simulate import noise_model
from isocharge.train.model_release.graph_check import check_graph
from isocharge.train.model_release.onnx_graph import read_graph, write_graph
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
    return trained.split.test


@pytest.fixture(scope="module")
def graph(trained):
    return write_graph(turned(trained.network, trained), {"note": "kept"})


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
    monkeypatch.setattr(correlation, "N_EXAMPLES", 1_000)  # errors that are nonsense have no correlations to find
    network = copy.deepcopy(trained.network)
    with torch.no_grad():
        network.contact.skip.weight *= 1e3
    exact = turned(network, trained)
    with pytest.raises(TrainingError, match=r"answers contact = .* expected finite numbers for any charges"):
        check_graph(write_graph(exact, {}), exact.outputs, held, REFERENCE)


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


@pytest.mark.parametrize("name", ["three-25um-biaxial", "four-25um-uniaxial-films", "four-25um-biaxial-student"])
def test_the_definition_read_from_a_released_model_writes_the_same_constants(name):
    released = (find_model(name) / "model.onnx").read_bytes()
    written = write_graph(read_graph(released, name), {})
    for before, after in zip(
        *(onnx.load_from_string(data).graph.initializer for data in (released, written)), strict=True
    ):
        np.testing.assert_array_equal(numpy_helper.to_array(before), numpy_helper.to_array(after))


def use_relu(model):
    model.graph.node[4].op_type = "Relu"


def bypass_a_layer(model):
    model.graph.node[5].input[0] = model.graph.node[3].output[0]


def split_into_other_widths(model):
    """Let y be one of the logarithms; all shapes still fit."""
    sizes = [tensor for tensor in model.graph.initializer if tensor.data_type == onnx.TensorProto.INT64]
    for tensor, widths in zip(sizes, ([1, 5, 3], [2, 3]), strict=True):
        tensor.CopyFrom(numpy_helper.from_array(np.array(widths), tensor.name))


def set_first_bias(model, values):
    bias = model.graph.initializer[4]
    bias.CopyFrom(numpy_helper.from_array(np.array(values, np.float32), bias.name))


def use_infinite_bias(model):
    set_first_bias(model, np.full(16, np.inf))


def use_one_bias_for_all_columns(model):
    set_first_bias(model, np.zeros(1))


def use_another_misfit_unit(model):
    unit = model.graph.initializer[-1]
    unit.CopyFrom(numpy_helper.from_array(np.float32(6.0), unit.name))


def add_a_node(model):
    model.graph.node.append(onnx.helper.make_node("Abs", ["misfit"], ["size"]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (use_relu, r"expected one of the activations .* after a Gemm, got \['Relu'\]"),
        (bypass_a_layer, r"expected the node Gemm\(result 0 of node 4, .*, got the node Gemm\(result 0 of node 3"),
        (
            split_into_other_widths,
            r"expected the node Split\(.*\(3,\), \[2, 4, 3\]\).*got the node Split\(.*\[1, 5, 3\]",
        ),
        (use_infinite_bias, "expected finite constants"),
        (use_one_bias_for_all_columns, r"expected a bias for each column of \(3, 16\), got \(1,\)"),
        (use_another_misfit_unit, r"expected the node Mul\(.*5\.0\).*got the node Mul\(.*6\.0\)"),
        (add_a_node, r"expected 16 nodes, got 17"),
    ],
)
def test_a_graph_of_another_program_is_refused(change, message):
    model = onnx.load_model_from_string(write_graph(random_network(3, (8, 8), (8, 8)), {}))
    read_graph(model.SerializeToString(), "f")
    change(model)
    with pytest.raises(ModelError, match=f"^f: .*{message}.*; only models of isocharge can be read"):
        read_graph(model.SerializeToString(), "f")


def test_a_file_that_is_not_onnx_is_refused():
    with pytest.raises(ModelError, match="f: not a valid ONNX file"):
        read_graph(b"nonsense", "f")
