"""Networks with random weights, for tests of what a network is written to, and comparisons of their answers."""

import itertools
from dataclasses import replace

import numpy as np
from msgspec import structs

from isocharge.serve import find_model, load_model, write_model
from isocharge.train.model_release.onnx_graph import write_graph
from isocharge.train.training.folded_network import ANGLES, LARGEST_INT8, FoldedNetwork, Layer, Perceptron
from isocharge.train.training.network import logarithmic_features

TYPICAL_pC = 512.0
"""Charge by which each charge is divided, pC."""

FLOORS = np.array([1.0, 1.0, 0.1, 1.0, 1.0, 0.1, 20.0, 5.0, 5.0, 5.0])
"""Values of a contact, mm, N, misfit and correlations, below which differences count as absolute differences."""


def random_perceptron(rng, widths):
    """Return a perceptron with random weights; `widths` are those of the inputs, the hidden layers and the outputs."""
    layers = []
    for n_input, n_output in itertools.pairwise(widths):
        weight = rng.standard_normal((n_input, n_output)) / np.sqrt(n_input)
        layers.append(Layer(weight, 0.3 * rng.standard_normal(n_output)))
    *hidden, last = layers
    skip = 0.1 * rng.standard_normal((widths[0], widths[-1]))
    return Perceptron(tuple(hidden), last, skip)


def random_network(n_electrode, hidden, misfit_hidden, *, is_int8=False):
    """Return a network with random weights.

    Args:
        n_electrode: Number of electrodes.
        hidden: Widths of the hidden layers of the contact perceptron.
        misfit_hidden: Widths of the hidden layers of the misfit perceptron.
        is_int8: Whether the weights between hidden layers are rounded to 8 bits.
    """
    rng = np.random.default_rng(0)
    n_contact = ANGLES.stop
    contact = random_perceptron(rng, (n_electrode, *hidden, n_contact))
    weight, bias = contact.last
    millimetres = np.array([8.0, 8.0, *np.ones(n_contact - 2)])
    contact = replace(contact, last=Layer(weight * millimetres, bias * millimetres), skip=contact.skip * millimetres)
    misfit = random_perceptron(rng, (n_electrode, *misfit_hidden, n_electrode))
    if is_int8:
        contact, misfit = map(round_to_int8, (contact, misfit))
    return FoldedNetwork(logarithmic_features(np.full((1, n_electrode), TYPICAL_pC)), contact, misfit)


def round_to_int8(perceptron):
    """Return a perceptron of two hidden layers, with weights between them that are rounded to 8 bits."""
    first, second = perceptron.hidden
    scale = np.abs(second.weight).max(axis=0) / LARGEST_INT8
    return replace(perceptron, hidden=(first, Layer(np.round(second.weight / scale) * scale, second.bias)))


def write_random_model(folder, network, **changes):
    """Write a model folder with a network, and with other metadata than a released model."""
    released = load_model(find_model("four-25um-biaxial")).metadata
    metadata = structs.replace(released, name=folder.name, version=1, **changes)
    charge_pC = np.random.default_rng(1).uniform(100.0, 3000.0, (64, network.features.n_electrode)).astype(np.float32)
    return write_model(folder, write_graph(network, metadata.to_props()), metadata, charge_pC, "card")


def double_precision_answers(network, charge_pC):
    """Return contact, standard deviations, misfit and correlations of a network, shape (n, 10)."""
    contact, std, correlation, misfit = network.outputs(charge_pC.astype(float))
    return np.concatenate([contact, std, misfit, correlation], axis=1)


def check_agreement(given, expected, tolerance=1e-5):
    """Check the relative differences of answers, shape (n, 10) or (n, 7) each."""
    scale = np.maximum(np.abs(expected), FLOORS[: expected.shape[1]])
    assert np.all(np.abs(given - expected) <= tolerance * scale)
