"""The contact network in every form is the trained network's contact."""

import numpy as np
import pytest
import torch

from isocharge.simulate import noise_model
from isocharge.train.rivals import Network, Task
from isocharge.train.rivals.networks import (
    BoundNetwork,
    NumpyNetwork,
    SessionNetwork,
    TorchNetwork,
    contact_graph,
    folded_layers,
)
from isocharge.train.split import domain_of, presses_of, split_by_position


@pytest.fixture(scope="module")
def forms(fit):
    layers = folded_layers(fit.network)
    graph = contact_graph(layers)
    return [
        TorchNetwork(fit.network, "", "n"),
        SessionNetwork(graph, "", "n"),
        BoundNetwork(graph, "", "n"),
        NumpyNetwork(layers, "", "n"),
    ]


def test_forms_give_the_networks_contact(fit, forms):
    charge = fit.held.charge_pC[:200]
    with torch.no_grad():
        expected = fit.network(torch.tensor(charge).float())[0].numpy()
    for form in forms:
        np.testing.assert_allclose(form.predict(charge), expected, rtol=1e-4, atol=1e-3, err_msg=form.form)
        single = np.array(
            [np.ravel(form.one(row)()) if form.form != "ONNX Runtime" else form.one(row)()[0][0] for row in charge[:9]]
        )
        np.testing.assert_allclose(single, expected[:9], rtol=1e-4, atol=1e-3, err_msg=form.form)


def test_absurd_charges_stay_finite(forms):
    charge = np.array([[0.0, 0.0, 0.0], [-5.0, 1e9, 3.0], [1e-30, 500.0, 500.0]])
    for form in forms:
        assert np.isfinite(form.predict(charge)).all()


def test_memory_is_that_of_the_weights(fit, forms):
    count = sum(parameter.numel() for parameter in fit.network.contact.parameters())
    for form in forms[:3]:
        assert 4 * count < form.memory < 4 * count + 8000
    assert 8 * 0.8 * count < forms[3].memory < 8 * count + 8000


def test_fitting_goes_through_the_pipeline(dataset):
    train, held = split_by_position(presses_of(dataset), 0.1, 0)
    task = Task(train, held, domain_of(dataset), noise_model("reference"))
    network = Network(dataset, hidden=(8, 8), steps=20)
    assert network.name == "network 8-8"
    made = network.fit(task)
    assert [form.form for form in made] == ["torch", "ONNX Runtime", "ONNX Runtime, bound", "NumPy"]
    assert {form.name for form in made} == {"network 8-8"}
