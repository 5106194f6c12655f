"""The network for all films: what is divided out is exact, and folded it is the conditional network."""

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
from isocharge.train.training.folded_network import MISFIT_UNIT
from isocharge.train.training.output_regression import adapt_to_charges

AT, FORCE = (3.0, -4.0), 0.3


def solved(prior, parameters, at, force):
    """Charges of one solve, pC."""
    sensor, probe = prior.film(parameters)
    return touch_charge(sensor, press(sensor.film, probe, at, force))


def changed(prior, **values):
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
        ({"thickness": 0.05}, 2e-3),  # what is left is the bending
    ],
)
def test_charges_scale_and_places_rotate_exactly(films, film, rtol):
    """The film's charge is the mean film's at the place and force that it stands for, times the exact factors."""
    prior, scaling = films.prior, FilmScaling(films.prior, films.domain)
    parameters = changed(prior, **film)
    unit = scaling.domain.to_unit(np.array([[*AT, FORCE]]))
    x, y, force = scaling.domain.to_contact(scaling.to_film(parameters, unit))[0]
    factor = np.exp(scaling.log_charge_scale(parameters) - scaling.log_charge_scale(prior.mean))
    expected = factor * solved(prior, prior.mean, AT, FORCE)
    np.testing.assert_allclose(solved(prior, parameters, (x, y), force), expected, rtol=rtol)


def test_the_electrodes_carry_the_place_along(films):
    """The frame in which the network works is the electrodes': they stand where `place` puts them."""
    prior, scaling = films.prior, films.scaling
    parameters = changed(prior, shift_x=0.4, shift_y=-0.2, rotation=0.1)
    sensor, _ = prior.film(parameters)
    centres = np.array([electrode.centre for electrode in prior.sensor.electrodes])
    units = np.column_stack([centres / scaling.domain.radius, np.zeros(len(centres))])
    moved = scaling.to_film(parameters, units)[:, :2] * scaling.domain.radius
    np.testing.assert_allclose(moved, sensor.calibration.place(centres), atol=1e-9)


THREE = load_sensor("three-25um-biaxial")


def by_torch(films, inputs, parts, parameters, charge):
    """What the torch networks answer about one film, in single precision as they are trained."""
    film = parameters[None]
    with torch.no_grad():
        values = inputs.values(torch.tensor(charge[None]).float(), film)
        out, residual = (part(values, inputs.context(film))[0].double().numpy() for part in parts)
    unit = films.scaling.to_film(np.broadcast_to(parameters, (len(out), parameters.size)), out[:, :3])
    contact, std = films.domain.to_contact(unit), np.exp(out[:, 3:]) * films.domain.scale
    std[:, 2] *= contact[:, 2]
    return contact, std, MISFIT_UNIT * np.sinh(np.linalg.norm(residual, axis=1, keepdims=True))


@pytest.mark.parametrize(
    "sensor",
    [
        load_sensor("four-25um-biaxial"),
        THREE,
        replace(THREE, calibration=Calibration({"A": 1.3}, (0.5, -0.3), 0.2)),  # the film's own deviations on top
    ],
    ids=["four", "three", "calibrated"],
)
def test_folded_is_the_conditional_network(random_films, sensor):
    model, inputs, parts = random_films(sensor)
    for parameters in model.prior.draw(np.random.default_rng(4), 3):
        charge = model.film(parameters, correlation=False).test.noisy(model.noise, seed=0)[:40]
        folded, expected = model.fold(parameters).predict(charge), by_torch(model, inputs, parts, parameters, charge)
        for mine, theirs in zip(folded, expected, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize(
    "factor",
    [None, lambda contact: 0.5 * np.exp(0.02 * contact[:, :2] @ [[1.0, -1.0, 0.5, 0.0], [0.0, 1.0, 0.5, -1.0]])],
    ids=["known", "half the charges, aslant"],
)
def test_its_intervals_hold(films, drawn, factor):
    """The 95 % intervals hold 92 to 98 % of the coordinates, and the misfit is that of noise."""
    errors = [evaluate(films.film(parameters, correlation=False, charge_factor=factor)) for parameters in drawn]
    assert 0.92 < np.mean([error["coverage_95"] for error in errors]) < 0.98
    assert np.median([error["misfit_p99"] for error in errors]) < 5.0


def test_what_is_linear_in_the_logarithms_is_corrected_exactly(films, drawn):
    """Charges of channels that are mixed, by 200 of them; the others are answered as those that they stand for."""
    network, rng = films.fold(drawn[0]), np.random.default_rng(2)
    logs = rng.normal(6.0, 0.3, (300, 4))
    as_if = np.exp(logs @ rng.normal(np.eye(4), 0.1) + 0.7)
    expected = network.predict(as_if)
    found = adapt_to_charges(network, np.exp(logs[:200]), as_if[:200], expected[0][:200]).predict(np.exp(logs))
    np.testing.assert_allclose(np.hstack(found[::2]), np.hstack(expected[::2]), rtol=1e-6)


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
def test_what_is_no_film_is_refused(films, parameters, error, message):
    with pytest.raises(error, match=message):
        films.film(parameters)


def test_a_film_becomes_a_served_model(films, random_films, drawn, tmp_path):
    """Its graph is node for node that of the model that was trained on the film as described: the same speed."""
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
    mine, trained = (onnx.load(path).graph for path in (folder / "model.onnx", released))
    assert [node.op_type for node in mine.node] == [node.op_type for node in trained.node]
    assert [list(c.dims) for c in mine.initializer] == [list(c.dims) for c in trained.initializer]
    three, _, _ = random_films(THREE)
    with pytest.raises(ModelError, match="other than one with the electrodes"):
        release(three.film(three.prior.mean, correlation=False), tmp_path / "mine", version=2)
