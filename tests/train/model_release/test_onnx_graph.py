"""The exported graph against the network from which it was written; graphs that the reader refuses."""

from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import numpy_helper
from tests.train.random_networks import check_agreement, double_precision_answers, random_network

from isocharge.common.errors import ModelError, TrainingError
from isocharge.serve.model.contact import MISFIT_LIMIT
from isocharge.serve.model.session import COLUMNS
from isocharge.simulate import noise_model
from isocharge.train.model_release.onnx_graph import check_graph, read_graph, write_graph
from isocharge.train.training.config import NetworkConfig
from isocharge.train.training.network import InverseNetwork, fold_network

REFERENCE = noise_model("reference")

EXTREME_FACTORS = {"negative": -1.0, "zero": 0.0, "tiny": 1e-30, "huge": 1e30}
"""Factors of charges that no film gives."""

FACTORS = {"ten times": 10.0, "dead electrode": [0.0, 1.0, 1.0], **EXTREME_FACTORS}


@pytest.fixture(scope="module")
def held_out(fitted):
    return fitted.test


@pytest.fixture(scope="module")
def exact(fitted):
    return fitted.network


@pytest.fixture(scope="module")
def graph(exact):
    return write_graph(exact, {"note": "kept"})


@pytest.fixture(scope="module")
def session(graph):
    return onnxruntime.InferenceSession(graph, providers=["CPUExecutionProvider"])


def test_folded_network_gives_the_answers_of_pytorch(split):
    """The network has random weights, which are evaluated with PyTorch in double precision."""
    torch.manual_seed(0)
    network = InverseNetwork(
        split.domain, split.features(REFERENCE), split.train.charge, NetworkConfig((32, 32), (24, 24))
    )
    for perceptron in (network.contact, network.misfit_vector):
        torch.nn.init.normal_(perceptron.skip.weight, std=0.1)
    folded = fold_network(network)
    network = network.double()
    charge = split.test.charge
    with torch.no_grad():
        posterior = network.posterior(torch.tensor(charge))
        misfit_vector = network.misfit_vector(network.inputs(torch.tensor(charge))).numpy()
    domain = network.domain
    contact = posterior.mean.numpy() * domain.scale + domain.centre
    contact[:, 2] = np.exp(contact[:, 2])
    std = np.exp(posterior.log_std.numpy()) * domain.scale
    std[:, 2] *= contact[:, 2]
    misfit = MISFIT_LIMIT * np.sinh(np.linalg.norm(misfit_vector, axis=1, keepdims=True))
    a, b, c = posterior.turn.numpy().T + 0.5 * np.pi  # angles of the rows of a Cholesky factor
    correlation = np.transpose([np.cos(a), np.cos(b), np.cos(a) * np.cos(b) + np.sin(a) * np.sin(b) * np.cos(c)])
    for given, expected in zip(folded.outputs(charge), (contact, std, correlation, misfit), strict=True):
        np.testing.assert_allclose(given, expected, rtol=1e-6, atol=1e-9)


def test_the_file_is_plain_onnx_with_its_metadata(graph):
    model = onnx.load_from_string(graph)
    assert {entry.key: entry.value for entry in model.metadata_props} == {"note": "kept"}
    assert {entry.domain for entry in model.opset_import} == {""}


@pytest.mark.parametrize("case", ["noisy", *FACTORS])
def test_the_graph_answers_as_the_network_does(exact, held_out, session, case):
    is_noisy = case == "noisy"
    charge = held_out.repeated(10_000).noisy(REFERENCE, seed=0) if is_noisy else held_out.charge * FACTORS[case]
    charge = charge.astype(np.float32)
    given = np.concatenate(session.run([*COLUMNS], {"charge_pC": charge}), axis=1)
    assert np.isfinite(given).all()
    check_agreement(given, double_precision_answers(exact, charge), tolerance=1e-5 if is_noisy else 1e-4)
    if case in EXTREME_FACTORS:
        assert given[:, 6].min() > 50.0  # the misfit


def test_a_network_with_infinite_answers_is_not_released(exact, held_out):
    diverging = replace(exact, misfit=replace(exact.misfit, skip=100.0 * exact.misfit.skip))
    with pytest.raises(TrainingError, match=r"answers misfit = .* expected finite numbers for any charges"):
        check_graph(write_graph(diverging, {}), diverging.outputs, held_out, REFERENCE)


def test_charges_with_large_rounding_errors_are_no_golden_vectors(exact, held_out, graph):
    golden_pC = check_graph(graph, exact.outputs, held_out, REFERENCE)

    def outputs_with_rounding_error(charge):
        contact, *others = exact.outputs(charge)
        is_first = (charge == golden_pC[0]).all(axis=1, keepdims=True)
        return contact + 5e-6 * is_first, *others

    fewer_pC = check_graph(graph, outputs_with_rounding_error, held_out, REFERENCE)
    assert fewer_pC.tolist() == golden_pC[1:].tolist()


@pytest.mark.parametrize("column", range(4))
def test_a_graph_that_disagrees_with_its_network_is_refused(exact, held_out, graph, column):
    def changed_outputs(charge):
        outputs = list(exact.outputs(charge))
        outputs[column] = outputs[column] * (1.0 + 1e-3)
        return tuple(outputs)

    with pytest.raises(TrainingError, match=r"got \d of 64 presses that agree"):
        check_graph(graph, changed_outputs, held_out, REFERENCE)


def use_relu(model):
    model.graph.node[4].op_type = "Relu"


def set_first_bias(model, values):
    bias = model.graph.initializer[4]
    bias.CopyFrom(numpy_helper.from_array(np.array(values, np.float32), bias.name))


def use_infinite_bias(model):
    set_first_bias(model, np.full(16, np.inf))


def use_one_bias_for_all_columns(model):
    set_first_bias(model, np.zeros(1))


def add_a_node(model):
    model.graph.node.append(onnx.helper.make_node("Abs", ["misfit"], ["size"]))


def remove_a_constant(model):
    del model.graph.initializer[-3]


@pytest.mark.parametrize(
    "change",
    [
        use_relu,
        use_infinite_bias,
        use_one_bias_for_all_columns,
        add_a_node,
        remove_a_constant,
    ],
)
def test_a_graph_of_another_program_is_refused(change):
    model = onnx.load_model_from_string(write_graph(random_network(3, (8, 8), (8, 8)), {}))
    read_graph(model.SerializeToString(), "f")
    change(model)
    with pytest.raises(ModelError, match=r"^f: (expected a graph that isocharge has written|not a valid ONNX file)"):
        read_graph(model.SerializeToString(), "f")
