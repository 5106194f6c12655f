"""The network in C against onnxruntime and against the network in double precision."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from tests.train.random_networks import (
    check_agreement,
    double_precision_answers,
    random_network,
    write_random_model,
)

from isocharge.serve import find_model, load_model
from isocharge.serve.model.session import COLUMNS
from isocharge.train.model_release.onnx_graph import read_graph
from isocharge.train.training.network import signed_features

MODELS = ("three-25um-biaxial", "four-25um-uniaxial", "four-25um-biaxial-student")


def onnxruntime_answers(model, charge_pC):
    """Run a model one press at a time, as a host program does; shape (n, 10)."""
    session = load_model(find_model(model)).session
    rows = [np.concatenate(session.run([*COLUMNS], {"charge_pC": charge[None]}), axis=1)[0] for charge in charge_pC]
    return np.array(rows)


@pytest.mark.parametrize("model", MODELS)
def test_extreme_charges_are_finite_as_in_onnxruntime_and_nan_is_nan(model, build):
    """Zero, negative, huge, denormal and infinite charges; their misfits are large."""
    exported = build(model)
    values = (0.0, -1.0, -3e38, 1e-45, 1.0, 800.0, 1e6, 3e38, np.inf, -np.inf)
    charge_pC = np.array(list(itertools.product(values, repeat=exported.electrodes)), np.float32)[::23]
    given = exported.predict(charge_pC)
    assert np.isfinite(given).all()
    # The answers are large there and pass through exponentials, which amplify the error of 4e-7 of tanh to 1e-4.
    check_agreement(given, onnxruntime_answers(model, charge_pC), tolerance=1e-3)
    one_nan = np.where(np.eye(exported.electrodes, dtype=bool), np.nan, 800.0)
    assert np.isnan(exported.predict(one_nan)).all()


@pytest.mark.parametrize(
    ("electrodes", "hidden", "misfit_hidden", "is_int8", "arrays"),
    [
        (3, (32, 32), (24, 24), False, ["float contact_1_weights[1024]", "float misfit_1_weights[576]"]),
        (4, (5, 7), (9, 3), True, ["signed char contact_1_weights[35]", "signed char misfit_1_weights[27]"]),
        (5, (48, 48, 48), (33, 17, 8), False, ["float misfit_2_weights[136]", "float misfit_last_weights[40]"]),
        (8, (24,), (16,), False, ["float contact_0_weights[192]", "float contact_last_weights[336]"]),
    ],
)
def test_any_width_and_number_of_electrodes(electrodes, hidden, misfit_hidden, is_int8, arrays, build, tmp_path):
    """The zeros beside the two blocks of a layer of the graph are left out, and weights of 8 bits take one byte."""
    network = random_network(electrodes, hidden, misfit_hidden, is_int8=is_int8)
    names = tuple(f"E{number} */" for number in range(electrodes))  # they could end a comment in C
    folder = write_random_model(tmp_path / "random", network, electrodes=names)
    exported = build(folder)
    charge_pC = np.random.default_rng(2).uniform(50.0, 5000.0, (500, electrodes)).astype(np.float32)
    expected = double_precision_answers(network, charge_pC)
    check_agreement(exported.predict(charge_pC), expected)
    read_network = read_graph((folder / "model.onnx").read_bytes(), "graph")
    check_agreement(double_precision_answers(read_network, charge_pC), expected)
    assert all(f"static const {array}" in exported.source for array in arrays)
    assert ("signed char" in exported.source) == is_int8


def test_large_logarithms_are_limited_as_in_onnxruntime(build, tmp_path):
    """The standard deviations of an unlimited network would be infinite and zero in single precision."""
    network = random_network(4, (24, 24), (16, 16)).with_scaled_std(1e50, 1e-50)
    charge_pC = np.random.default_rng(2).uniform(50.0, 5000.0, (500, 4)).astype(np.float32)
    folder = write_random_model(tmp_path / "limited", network)
    answers = onnxruntime_answers(folder, charge_pC), build(folder).predict(charge_pC)
    for std in (*(rows[:, 3:6] for rows in answers), network.outputs(charge_pC)[1]):
        np.testing.assert_allclose(np.log(std), np.full((500, 3), [50.0, 50.0, -50.0]), rtol=1e-6)


def test_signed_charges(build, tmp_path):
    """Features with asinh: against the network in double precision, and against onnxruntime beyond the limits."""
    mean_pC = [0.0, -300.0, 900.0, 5.0]
    std_pC = [200.0, 100.0, 300.0, 2.0]
    typical_pC = np.array([20.0, 50.0, 10.0, 3.0])
    drawn_pC = np.random.default_rng(3).normal(mean_pC, std_pC, (1_000, 4))
    network = replace(random_network(4, (24, 24), (16, 16)), features=signed_features(drawn_pC, typical_pC))
    folder = write_random_model(tmp_path / "signed", network)
    exported = build(folder)
    charge_pC = drawn_pC.astype(np.float32)
    check_agreement(exported.predict(charge_pC), double_precision_answers(network, charge_pC))
    beyond_limits = np.float32([[np.inf, -np.inf, 0.0, 1e38], [-1e9, 1e9, -np.inf, np.inf]])
    check_agreement(exported.predict(beyond_limits), onnxruntime_answers(folder, beyond_limits))
    one_nan = np.where(np.eye(4, dtype=bool), np.nan, charge_pC[:4]).astype(np.float32)
    assert np.isnan(exported.predict(one_nan)).all()
    assert np.isnan(onnxruntime_answers(folder, one_nan)).all()
