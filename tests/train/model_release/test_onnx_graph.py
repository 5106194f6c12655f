"""The exported graph against the network from which it was written; graphs that the reader refuses."""

from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import numpy_helper
from tests.train.random_networks import random_network

from isocharge.common.errors import ModelError, TrainingError
from isocharge.serve import find_model
from isocharge.serve.model.contact import MISFIT_LIMIT
from isocharge.simulate import noise_model
from isocharge.train.model_release.onnx_graph import check_graph, read_graph, write_graph
from isocharge.train.training.config import NetworkConfig
from isocharge.train.training.network import InverseNetwork, fold_network

REFERENCE = noise_model("reference")

EXTREME_FACTORS = {"negative": -1.0, "zero": 0.0, "tiny": 1e-30, "huge": 1e30}
"""Factors of charges that no film gives."""

FACTORS = {"ten times": 10.0, "dead electrode": [0.0, 1.0, 1.0], **EXTREME_FACTORS}

OUTPUTS = ["contact", "contact_std", "misfit"]

FLOORS = ([1.0, 1.0, 0.1], [1.0, 1.0, 0.1], [1.0])
"""Values of the outputs, mm, N and standard deviations, below which differences count as absolute differences."""

TOLERANCE = 1e-5
"""Largest relative difference of contact and standard deviations that float32 causes on the charges of a film.

The difference of the misfit may be ten times as large."""


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


def graph_outputs(session, charge):
    return session.run(OUTPUTS, {"charge_pC": charge.astype(np.float32)})


def answers(network, charge):
    """Return the contacts, standard deviations and misfits of a network in double precision."""
    contact, std, _, misfit = network.outputs(charge)
    return contact, std, misfit


def largest_differences(given, expected):
    """Return the largest relative difference of each output."""
    return [
        float(np.max(np.abs(given_output - output) / np.maximum(np.abs(output), floor)))
        for given_output, output, floor in zip(given, expected, FLOORS, strict=True)
    ]


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
    for given, expected in zip(answers(folded, charge), (contact, std, misfit), strict=True):
        np.testing.assert_allclose(given, expected, rtol=1e-6)


def test_the_file_is_plain_onnx_with_its_metadata(graph):
    model = onnx.load_from_string(graph)
    assert {entry.key: entry.value for entry in model.metadata_props} == {"note": "kept"}
    assert {entry.domain for entry in model.opset_import} == {""}


@pytest.mark.parametrize("case", ["noisy", *FACTORS])
def test_the_graph_answers_as_the_network_does(exact, held_out, session, case):
    if case == "noisy":
        charge = held_out.repeated(10_000).noisy(REFERENCE, seed=0).astype(np.float32)
    else:
        charge = (held_out.charge * FACTORS[case]).astype(np.float32)
    outputs = graph_outputs(session, charge)
    factor = 1.0 if case == "noisy" else 10.0
    contact, std, misfit = largest_differences(outputs, answers(exact, charge))
    assert max(contact, std) < factor * TOLERANCE
    assert misfit < 10.0 * TOLERANCE
    assert all(np.isfinite(output).all() for output in outputs)
    if case in EXTREME_FACTORS:
        assert outputs[2].min() > 50.0


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


@pytest.mark.parametrize("name", ["three-25um-biaxial", "four-25um-uniaxial", "four-25um-biaxial-student"])
def test_the_definition_read_from_a_released_model_writes_the_same_constants(name):
    released = onnx.load(find_model(name) / "model.onnx").graph
    network = read_graph((find_model(name) / "model.onnx").read_bytes(), name)
    written = onnx.load_from_string(write_graph(network, {})).graph
    for before, after in zip(released.initializer, written.initializer, strict=True):
        np.testing.assert_array_equal(numpy_helper.to_array(before), numpy_helper.to_array(after))


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


def test_a_file_that_is_not_onnx_is_refused():
    with pytest.raises(ModelError, match="f: not a valid ONNX file"):
        read_graph(b"nonsense", "f")
