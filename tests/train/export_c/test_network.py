"""The network in C against onnxruntime and against the network in double precision."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from tests.train.random_networks import random_network

from isocharge.serve import find_model, load_model, write_model
from isocharge.serve.model.session import output_widths
from isocharge.simulate import load_sensor, noise_model
from isocharge.train.data.presses import draw_contacts
from isocharge.train.model_release.onnx_graph import write_graph
from isocharge.train.training.features import signed_features

FLOORS = np.array([1.0, 1.0, 0.1, 1.0, 1.0, 0.1, 20.0, 5.0, 5.0, 5.0])
"""mm and N, and larger ones for the misfit, which golden vectors have, too, and the correlations."""

MODELS = ("three-25um-biaxial", "four-25um-biaxial", "four-25um-uniaxial-films", "four-25um-biaxial-student")


def answers(model, charge_pC):
    """What onnxruntime answers, one press at a time as a host program asks, shape (n, 10 or 7)."""
    session = load_model(find_model(model)).session
    names = sorted(output_widths(session), key="contact_correlation".__eq__)
    return np.array([np.concatenate(session.run(names, {"charge_pC": row[None]}), axis=1)[0] for row in charge_pC])


def check_agreement(mine, theirs, limit=1e-5):
    assert np.all(np.abs(mine - theirs) <= limit * np.maximum(np.abs(theirs), FLOORS[: theirs.shape[1]]))


@pytest.mark.parametrize("model", ["three-25um-biaxial", "four-25um-biaxial"])
def test_ten_thousand_noisy_presses_agree_with_onnxruntime(model, build, film):
    rng, known = np.random.default_rng(0), replace(film, sensor=load_sensor(model))
    charge = known.charges(draw_contacts(rng, film.domain.within(7.9), 10_000))
    charge_pC = noise_model("reference").add(charge, rng).astype(np.float32)
    check_agreement(build(model).predict(charge_pC), answers(model, charge_pC))


@pytest.mark.parametrize("model", MODELS)
def test_absurd_charges_are_finite_as_in_onnxruntime_and_nan_is_nan(model, build):
    """Zeros, negative and huge charges, denormal numbers and infinities; the misfit there is the sinh of tens."""
    exported = build(model)
    values = (0.0, -1.0, -3e38, 1e-45, 1.0, 800.0, 1e6, 3e38, np.inf, -np.inf)
    corners = np.array(list(itertools.product(values, repeat=exported.electrodes)), np.float32)[::7]
    mine = exported.predict(corners)
    assert np.isfinite(mine).all()
    # The logarithms go far beyond any press there, and with them the exponentials: 4e-7 in tanh are 1e-4 here.
    check_agreement(mine, answers(model, corners), 1e-3)
    charge_pC = np.where(np.eye(exported.electrodes, dtype=bool), np.nan, 800.0)
    assert np.isnan(exported.predict(charge_pC)).all()


def written(folder, network):
    """A model folder of a network."""
    names = tuple(f"E{number} */" for number in range(network.features.n_electrode))
    about = structs.replace(load_model(find_model(MODELS[0])).metadata, name=folder.name, version=1, electrodes=names)
    charges = np.random.default_rng(1).uniform(100.0, 3000.0, (64, len(names))).astype(np.float32)
    return write_model(folder, write_graph(network, about.to_props()), about, charges, "card")


@pytest.mark.parametrize(
    ("electrodes", "contact", "misfit", "int8", "arrays"),
    [
        (3, (32, 32), (24, 24), False, ["float layer_1_weights_0[1024]", "float layer_1_weights_1[576]"]),
        (4, (5, 7), (9, 3), True, ["signed char layer_1_weights_0[35]", "signed char layer_1_weights_1[27]"]),
        (5, (48, 48, 48), (33, 17, 8), False, ["float layer_2_weights_1[136]", "float last_weights_1[40]"]),
        (8, (24,), (16,), False, ["float layer_0_weights_0[320]", "float last_weights_0[144]"]),
    ],
)
def test_any_width_and_number_of_electrodes(electrodes, contact, misfit, int8, arrays, build, tmp_path):
    """Against the network in double precision; zeros beside the two perceptrons are left out, 8 bits are a byte."""
    network = random_network(electrodes, contact, misfit, is_int8=int8)
    exported = build(written(tmp_path / "random", network))
    charge_pC = np.random.default_rng(2).uniform(50.0, 5000.0, (500, electrodes)).astype(np.float32)
    check_agreement(exported.predict(charge_pC), np.concatenate(network.predict(charge_pC.astype(float)), axis=1))
    assert all(f"static const {array}" in exported.source for array in arrays)
    assert ("signed char" in exported.source) == int8


def test_signed_charges(build, tmp_path):
    """asinh within bounds: against the network in double precision, and against onnxruntime beyond the bounds."""
    draw = np.random.default_rng(3).normal([0.0, -300.0, 900.0, 5.0], [200.0, 100.0, 300.0, 2.0], (1_000, 4))
    typical = np.array([20.0, 50.0, 10.0, 3.0])
    network = replace(random_network(4, (24, 24), (16, 16)), features=signed_features(draw, typical))
    folder = written(tmp_path / "signed", network)
    exported, charge_pC = build(folder), draw.astype(np.float32)
    check_agreement(exported.predict(charge_pC), np.concatenate(network.predict(charge_pC.astype(float)), axis=1))
    absurd = np.float32([[np.inf, -np.inf, 0.0, 1e38], [-1e9, 1e9, -np.inf, np.inf]])
    check_agreement(exported.predict(absurd), answers(folder, absurd))
    unknown = np.where(np.eye(4, dtype=bool), np.nan, charge_pC[:4]).astype(np.float32)
    assert np.isnan(exported.predict(unknown)).all()
    assert np.isnan(answers(folder, unknown)).all()
