"""Every activation of hidden layers: its values, and networks with it in ONNX and C."""

import numpy as np
import pytest
import torch
from msgspec import structs
from tests.train.random_networks import random_network

from isocharge.serve import Predictor, find_model, load_model, write_model
from isocharge.train.model_release.onnx_graph import read_graph, write_graph
from isocharge.train.training.folded_network import ACTIVATIONS

CLOSED_FORMS = {
    "tanh": lambda x: (np.exp(x) - np.exp(-x)) / (np.exp(x) + np.exp(-x)),
}
"""The value of each activation, in double precision."""

CONTACT_FLOORS = np.array([1.0, 1.0, 0.1, 1.0, 1.0, 0.1, 20.0])
"""Values of the outputs, mm, N and the misfit, below which differences count as absolute differences."""


def check_close(given, expected):
    tolerance = 2e-5 * np.maximum(np.abs(expected), CONTACT_FLOORS)
    np.testing.assert_array_less(np.abs(given - expected), tolerance)


def answers(network, charge_pC):
    """Return the contacts, standard deviations and misfits of a network in double precision, shape (n, 7)."""
    contact, std, _, misfit = network.outputs(charge_pC)
    return np.concatenate([contact, std, misfit], axis=1)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_torch_computes_the_closed_form(name):
    activation = ACTIVATIONS[name]
    x = np.linspace(-5.0, 5.0, 101)
    expected = CLOSED_FORMS[name](x)
    torch_function = getattr(torch.nn.functional, activation.torch_name)
    np.testing.assert_allclose(torch_function(torch.tensor(x)), expected, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_onnx_and_c_give_the_network(name, build, tmp_path):
    """Both are compared with the network in double precision, and the graph gives the same network back."""
    network = random_network(4, (24, 20), (16, 12), activation=ACTIVATIONS[name])
    electrodes = ("A", "B", "C", "D")
    released = load_model(find_model("four-25um-biaxial")).metadata
    metadata = structs.replace(released, name="random", version=1)
    charge_pC = np.random.default_rng(1).uniform(100.0, 3000.0, (64, len(electrodes))).astype(np.float32)
    graph = write_graph(network, metadata.to_props())
    folder = write_model(tmp_path / "random", graph, metadata, charge_pC, "card")

    expected = answers(network, charge_pC)
    check_close(np.stack(Predictor(folder).predict_batch(charge_pC), axis=1)[:, :7], expected)
    check_close(build(folder).predict(charge_pC)[:, :7], expected)

    read_network = read_graph(graph, "graph")
    assert read_network.misfit.activation.name == name
    check_close(answers(read_network, charge_pC), expected)
