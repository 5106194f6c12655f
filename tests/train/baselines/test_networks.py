"""The contact network in every form is the trained network's contact."""

import numpy as np
import pytest
import torch

from isocharge.simulate import noise_model
from isocharge.train.baselines import FittingTask, Network
from isocharge.train.baselines.networks import (
    BoundNetwork,
    NumpyNetwork,
    SessionNetwork,
    TorchNetwork,
    contact_graph,
    contact_of,
)
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.presses import domain_of, presses_of, split_by_position
from isocharge.train.release.export import export_onnx
from isocharge.train.release.folding import contact_alone, fold_network
from isocharge.train.training.network import Features, InverseNetwork

CHARGE = np.random.default_rng(0).uniform(100.0, 1500.0, (400, 3))


@pytest.fixture(scope="module")
def network():
    """Untrained: the forms have to agree on any weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        made = InverseNetwork(ContactDomain(8.0, (0.05, 2.0)), Features.fit(CHARGE), (24, 24), (8, 8))
        torch.nn.init.normal_(made.contact.skip.weight, std=0.3)
        return made.eval()


@pytest.fixture(scope="module")
def forms(network):
    layers = contact_alone(network)
    graph = contact_graph(layers)
    return [
        TorchNetwork(network, "", "n"),
        SessionNetwork(graph, "", "n"),
        BoundNetwork(graph, "", "n"),
        NumpyNetwork(layers, "", "n"),
    ]


def test_forms_give_the_networks_contact(network, forms):
    with torch.no_grad():
        expected = network(torch.tensor(CHARGE).float())[0].numpy()
    for form in forms:
        np.testing.assert_allclose(form.predict(CHARGE), expected, rtol=1e-4, atol=1e-4, err_msg=form.form)
        single = np.array([np.ravel(form.one(row)()).copy() for row in CHARGE[:9]])
        np.testing.assert_allclose(single, expected[:9], rtol=1e-4, atol=1e-4, err_msg=form.form)


def test_absurd_charges_stay_finite(forms):
    charge = np.array([[0.0, 0.0, 0.0], [-5.0, 1e9, 3.0], [1e-30, 500.0, 500.0]])
    for form in forms:
        assert np.isfinite(form.predict(charge)).all()


def test_memory_is_that_of_the_weights(network, forms):
    count = sum(parameter.numel() for parameter in network.contact.parameters())
    for form in forms[:3]:
        assert 4 * count < form.memory < 4 * count + 8000
    assert 8 * 0.8 * count < forms[3].memory < 8 * count + 8000


def test_the_contact_cut_out_of_a_released_graph(network, forms):
    cut = contact_of(export_onnx(fold_network(network), {}))
    alone = BoundNetwork(cut, "", "n")
    assert [output.name for output in alone.session.get_outputs()] == ["contact"]
    np.testing.assert_allclose(alone.predict(CHARGE), forms[1].predict(CHARGE), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(alone.one(CHARGE[0])(), alone.predict(CHARGE[:1])[0], rtol=1e-5, atol=1e-5)


def test_fitting_goes_through_the_pipeline(dataset):
    train, held = split_by_position(presses_of(dataset), 0.1, 0)
    task = FittingTask(train, held, domain_of(dataset), noise_model("reference"))
    network = Network(dataset, hidden=(8, 8), steps=20)
    assert network.name == "network 8-8"
    made = network.fit(task)
    assert [form.form for form in made] == ["torch", "ONNX Runtime", "ONNX Runtime, bound", "NumPy"]
    assert {form.name for form in made} == {"network 8-8"}
