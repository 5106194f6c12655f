"""The network for all films: exact scales of the charges, and the networks of single films."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from isocharge.common.errors import InputError, ModelError, SceneError
from isocharge.serve import Predictor, check_golden, load_model
from isocharge.simulate import Calibration, load_sensor, press, touch_charge
from isocharge.train import Provenance, evaluate, release
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.model_release.onnx_graph import read_graph, write_graph
from isocharge.train.training.folded_network import MISFIT_UNIT
from isocharge.train.training.folding import log_std_limits
from isocharge.train.training.output_regression import adapt_to_charges

POSITION_mm = (3.0, -4.0)
FORCE_N = 0.3


def solved_charge(prior, parameters, position_mm, force_N):
    """Simulate one press, and return its charges, pC."""
    sensor, probe = prior.film(parameters)
    return touch_charge(sensor, press(sensor.film, probe, position_mm, force_N))


def changed_parameters(prior, **values):
    """Return the mean parameters of a prior with other values for some of them."""
    parameters = prior.mean.copy()
    for name, value in values.items():
        parameters[prior.names.index(name.replace("gain_", "gain "))] = value
    return parameters


@pytest.mark.parametrize(
    ("film", "rtol"),
    [
        ({"gain_B": 0.1}, 2e-4),
        ({"d31": 0.3, "d32": 0.3}, 2e-4),
        ({"young": 0.4, "pretension": 1.5 * np.exp(0.4)}, 2e-4),
        ({"rotation": 0.2}, 2e-4),
        (
            {"rotation": -0.1, "young": -0.2, "pretension": 1.5 * np.exp(-0.2), "d31": 0.1, "d32": 0.1, "gain_A": 0.05},
            2e-4,
        ),
        ({"thickness": 0.05}, 2e-3),  # bending does not scale in the same way
    ],
)
def test_charges_scale_and_positions_rotate_exactly(films, film, rtol):
    """The charges of a film are those of the mean film at the transformed contact, times the exact factors."""
    prior = films.prior
    scaling = FilmScaling(prior, films.domain)
    parameters = changed_parameters(prior, **film)
    unit = scaling.domain.to_unit(np.array([[*POSITION_mm, FORCE_N]]))
    [(x_mm, y_mm, force_N)] = scaling.domain.to_contact(scaling.to_film(parameters, unit))
    factor = np.exp(scaling.log_charge_scale(parameters) - scaling.log_charge_scale(prior.mean))
    expected = factor * solved_charge(prior, prior.mean, POSITION_mm, FORCE_N)
    np.testing.assert_allclose(solved_charge(prior, parameters, (x_mm, y_mm), force_N), expected, rtol=rtol)


def test_positions_move_with_the_electrodes(films):
    """The network works in the frame of the electrodes, which the calibration of the sensor places."""
    prior = films.prior
    scaling = films.scaling
    parameters = changed_parameters(prior, shift_x=0.4, shift_y=-0.2, rotation=0.1)
    sensor, _ = prior.film(parameters)
    centres = np.array([electrode.centre for electrode in prior.sensor.electrodes])
    units = np.column_stack([centres / scaling.domain.radius, np.zeros(len(centres))])
    moved = scaling.to_film(parameters, units)[:, :2] * scaling.domain.radius
    np.testing.assert_allclose(moved, sensor.calibration.place(centres), atol=1e-9)


THREE = load_sensor("three-25um-biaxial")


def torch_answers(films, inputs, networks, parameters, charge):
    """Evaluate the PyTorch networks for one film, in single precision as in the training."""
    film = parameters[None]
    with torch.no_grad():
        values = inputs.values(torch.tensor(charge[None]).float(), film)
        contact_outputs, misfit_vector = (
            network(values, inputs.context(film))[0].double().numpy() for network in networks
        )
    mean, log_std = np.split(contact_outputs, 2, axis=1)
    contact = films.domain.to_contact(films.scaling.to_film(np.tile(film, (len(mean), 1)), mean))
    log_std += np.log(films.domain.scale)
    log_std[:, 2] += np.log(contact[:, 2])
    std = np.exp(np.clip(log_std, *log_std_limits(films.domain)))
    length = np.linalg.norm(misfit_vector, axis=1, keepdims=True)
    return contact, std, MISFIT_UNIT * np.sinh(length)


@pytest.mark.parametrize(
    "sensor",
    [
        load_sensor("four-25um-biaxial"),
        THREE,
        replace(THREE, calibration=Calibration({"A": 1.3}, (0.5, -0.3), 0.2)),  # a described calibration in addition
    ],
    ids=["four", "three", "calibrated"],
)
def test_the_network_of_a_film_is_the_conditional_network(random_films, sensor):
    model, inputs, networks = random_films(sensor)
    for parameters in model.prior.draw(np.random.default_rng(4), 3):
        charge = model.film(parameters, correlation=False).test.noisy(model.noise, seed=0)[:40]
        answers = model.fold(parameters).predict(charge)
        expected_answers = torch_answers(model, inputs, networks, parameters, charge)
        for answer, expected in zip(answers, expected_answers, strict=True):
            np.testing.assert_allclose(answer, expected, rtol=1e-5, atol=2e-5)


@pytest.mark.first_cases(1)
@pytest.mark.parametrize(
    "factor",
    [None, lambda contact: 0.5 * np.exp(0.02 * contact[:, :2] @ [[1.0, -1.0, 0.5, 0.0], [0.0, 1.0, 0.5, -1.0]])],
    ids=["the simulated film", "half of the charges, with a gradient"],
)
def test_the_intervals_of_films_contain_the_truth(films, drawn, factor):
    """The 95 % intervals contain 92 to 98 % of the coordinates, and the misfits are those of noise."""
    errors = [evaluate(films.film(parameters, correlation=False, charge_factor=factor)) for parameters in drawn]
    assert 0.92 < np.mean([error["coverage_95"] for error in errors]) < 0.98
    assert np.median([error["misfit_p99"] for error in errors]) < 5.0


def test_a_linear_map_of_the_logarithms_is_corrected_exactly(films, drawn):
    """The map is fitted to 200 presses; the adapted network also answers the other 100 correctly."""
    network = films.fold(drawn[0])
    rng = np.random.default_rng(2)
    logarithms = rng.normal(6.0, 0.3, (300, 4))
    charge = np.exp(logarithms)
    equivalent = np.exp(logarithms @ rng.normal(np.eye(4), 0.1) + 0.7)
    expected_contact, _, expected_misfit = network.predict(equivalent)
    adapted = adapt_to_charges(network, charge[:200], equivalent[:200], expected_contact[:200])
    contact, _, misfit = adapted.predict(charge)
    np.testing.assert_allclose(contact, expected_contact, rtol=1e-6)
    np.testing.assert_allclose(misfit, expected_misfit, rtol=1e-6)


NO_FILM = r"expected 13 finite parameters \(pretension, young"


@pytest.mark.parametrize(
    ("parameters", "error", "message"),
    [
        (np.zeros(3), InputError, NO_FILM),
        (np.full(13, np.nan), InputError, NO_FILM),
        (np.zeros((2, 13)), InputError, NO_FILM),
        (np.append(20.0, np.zeros(12)), SceneError, r"tension .* is outside the family"),
    ],
    ids=["few", "not finite", "two films", "outside"],
)
def test_wrong_parameters_are_refused(films, parameters, error, message):
    with pytest.raises(error, match=message):
        films.film(parameters)


def test_a_film_becomes_a_served_model(films, random_films, drawn, tmp_path):
    """The graph has the nodes of a model that was trained on a single film, so it is as fast."""
    fitted = films.film(drawn[0], provenance=Provenance(files={"presses.csv": b"x_mm\n"}))
    folder = release(fitted, tmp_path / "mine", command="test", card=lambda about, _: f"# {about.name}\n").folder
    model = load_model(folder)
    check_golden(model)
    served = np.stack(Predictor(folder).predict_batch(fitted.test.charge), axis=1)
    np.testing.assert_allclose(served[:, :3], fitted.predict(fitted.test.charge)[0], rtol=1e-4, atol=1e-4)
    assert (model.metadata.made_with["command"], model.metadata.dataset_sha256) == ("test", films.sha256)
    assert model.metadata.sensor["film"]["pretension_MPa"] == pytest.approx(drawn[0][0])
    assert (folder / "card.md").read_text().endswith("\n# mine\n")
    assert (folder / "presses.csv").read_bytes() == b"x_mm\n"
    released = Path(__file__).parents[3] / "models" / "four-25um-biaxial" / "1" / "model.onnx"
    released_network = replace(read_graph(released.read_bytes(), "f"), log_std_limits=fitted.network.log_std_limits)
    trained = onnx.load_from_string(write_graph(released_network, {})).graph
    mine = onnx.load(folder / "model.onnx").graph
    assert [node.op_type for node in mine.node] == [node.op_type for node in trained.node]
    assert [list(c.dims) for c in mine.initializer] == [list(c.dims) for c in trained.initializer]
    three, _, _ = random_films(THREE)
    with pytest.raises(ModelError, match="other than one with the electrodes"):
        release(three.film(three.prior.mean, correlation=False), tmp_path / "mine", version=2)
