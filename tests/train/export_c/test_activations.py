"""Every activation of hidden layers: its values, and networks with it in ONNX and C."""

import numpy as np
import pytest
import torch
from tests.train.random_networks import (
    check_agreement,
    double_precision_answers,
    random_network,
    write_random_model,
)

from isocharge.serve import Predictor
from isocharge.train.model_release.onnx_graph import read_graph
from isocharge.train.training.folded_network import ACTIVATIONS

CLOSED_FORMS = {
    "tanh": lambda x: (np.exp(x) - np.exp(-x)) / (np.exp(x) + np.exp(-x)),
}
"""The value of each activation, in double precision."""


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
    folder = write_random_model(tmp_path / "random", network)
    charge_pC = np.random.default_rng(1).uniform(100.0, 3000.0, (64, 4)).astype(np.float32)
    expected = double_precision_answers(network, charge_pC)
    check_agreement(np.stack(Predictor(folder).predict_batch(charge_pC), axis=1), expected, 2e-5)
    check_agreement(build(folder).predict(charge_pC), expected, 2e-5)

    read_network = read_graph((folder / "model.onnx").read_bytes(), "graph")
    assert read_network.misfit.activation.name == name
    check_agreement(double_precision_answers(read_network, charge_pC), expected, 2e-5)
