"""Networks that give the contact alone give the whole network's contact."""

import numpy as np
import pytest
import torch

from isocharge.serve import find_model
from isocharge.simulate import Domain, noise_model
from isocharge.train import TrainingData
from isocharge.train.baselines.networks import OnnxContact, ReleasedModel, TrainedNetwork, contact_graph
from isocharge.train.data.presses import presses_of
from isocharge.train.training.folding import contact_alone
from isocharge.train.training.network import Features, InverseNetwork

CHARGE = np.random.default_rng(0).uniform(100.0, 1500.0, (400, 3))


@pytest.fixture(scope="module")
def network():
    """Untrained: they have to agree on any weights."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        network = InverseNetwork(Domain(8.0, (0.05, 2.0)), Features.fit(CHARGE), (24, 24), (8, 8))
        torch.nn.init.normal_(network.contact.skip.weight, std=0.3)
        return network.eval()


def check_contact(alone, expected):
    np.testing.assert_allclose(alone.predict(CHARGE), expected, rtol=1e-4, atol=1e-4)
    single = np.array([np.ravel(alone.single(row)())[:3].copy() for row in CHARGE[:9]])
    np.testing.assert_allclose(single, expected[:9], rtol=1e-4, atol=1e-4)


def test_the_graph_gives_the_networks_contact(network):
    with torch.no_grad():
        expected = network(torch.tensor(CHARGE).float())[0].numpy()
    graph = contact_graph(contact_alone(network))
    check_contact(OnnxContact(graph), expected)
    count = sum(parameter.numel() for parameter in network.contact.parameters())
    assert 4 * count < len(graph) < 4 * count + 8000
    absurd = np.array([[0.0, 0.0, 0.0], [-5.0, 1e9, 3.0], [1e-30, 500.0, 500.0]])
    assert np.isfinite(OnnxContact(graph).predict(absurd)).all()


def test_the_contact_cut_out_of_a_released_model():
    released = ReleasedModel(find_model("three-25um-biaxial"))
    check_contact(released.contact_only(), released.predict(CHARGE))
    assert len(released.contact_only().graph) < len(released.graph)


def test_fitting_goes_through_the_training(dataset):
    presses = presses_of(dataset)[np.arange(2000)]
    network = TrainedNetwork(TrainingData.of(dataset), (8, 8), 200, noise_model("reference"), 0)
    answers = network.fit(presses.charge, presses.contact).predict(presses.charge)
    assert np.median(np.hypot(*(answers - presses.contact)[:, :2].T)) < 1.5
