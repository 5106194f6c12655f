"""The network for all films, folded: equal to the conditional network, and a model like any other."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from isocharge.common.errors import InputError, ModelError, OutputExists, SceneError
from isocharge.serve import Predictor, check_golden, load_model
from isocharge.simulate import Calibration, load_sensor
from isocharge.train import write_film_model
from isocharge.train.data.noise import with_noise
from isocharge.train.films.films_model import fresh_presses
from isocharge.train.training.network import MISFIT_UNIT


def twin(films, inputs, parts, parameters, charge_pC):
    """What the torch networks answer about one film, in single precision as they are trained."""
    film = parameters[None]
    with torch.no_grad():
        values = inputs.values(torch.tensor(charge_pC[None]).float(), film)
        out, miss = (part(values, inputs.context(film))[0].double().numpy() for part in parts)
    unit = films.scaling.to_film(np.broadcast_to(parameters, (len(out), parameters.size)), out[:, :3])
    contact, std = films.domain.to_contact(unit), np.exp(out[:, 3:]) * films.domain.scale
    std[:, 2] *= contact[:, 2]
    return contact, std, MISFIT_UNIT * np.sinh(np.linalg.norm(miss, axis=1, keepdims=True))


@pytest.mark.parametrize("name", ["four-25um-biaxial", "three-25um-biaxial"])
def test_folded_is_the_conditional_network(random_films, name):
    model, inputs, parts = random_films(load_sensor(name))
    for parameters in model.prior.draw(np.random.default_rng(4), 5):
        presses = fresh_presses(model, parameters, 40)
        charge = with_noise(presses.charge_pC, model.noise, np.random.default_rng(0))
        for mine, theirs in zip(
            model.fold(parameters).predict(charge), twin(model, inputs, parts, parameters, charge), strict=True
        ):
            np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=2e-5)


def test_the_film_matters(films, drawn):
    """Told another film, it answers otherwise: by far more than noise explains."""
    presses = fresh_presses(films, drawn[0], 200)
    right, wrong = (films.fold(parameters).predict(presses.charge_pC)[0] for parameters in drawn[:2])
    off = [np.hypot(*(contact - presses.contact)[:, :2].T) for contact in (right, wrong)]
    assert np.median(off[1]) > 3.0 * np.median(off[0])


def test_told_the_film_its_intervals_hold(films, drawn):
    """Over fresh films the 95 % intervals hold 92 to 98 % of the coordinates, and the misfit is that of noise."""
    inside, misfits = [], []
    for k, parameters in enumerate(drawn):
        presses = fresh_presses(films, parameters, 400, seed=k)
        noisy = with_noise(presses.charge_pC, films.noise, np.random.default_rng(k))
        contact, std, misfit = films.fold(parameters).predict(noisy)
        inside.append(np.abs(contact - presses.contact) < 1.96 * std)
        misfits.append(misfit)
    assert 0.92 < np.mean(inside) < 0.98
    assert np.median(misfits) < 3.0


@pytest.mark.parametrize(
    "parameters", [np.zeros(3), np.full(13, np.nan), np.zeros((2, 13))], ids=["few", "not finite", "two films"]
)
def test_what_is_no_film_is_refused(films, parameters):
    with pytest.raises(InputError, match=r"expected 13 finite parameters \(pretension, young"):
        films.fold(parameters)


def test_a_film_becomes_a_served_model_in_under_a_second(films, drawn, tmp_path):
    started = time.perf_counter()
    folder = write_film_model(films, drawn[0], tmp_path / "mine", card="# mine\n", made_with={"command": "test"})
    assert time.perf_counter() - started < 3.0  # a busy machine; the benchmark asks for one
    model, presses = load_model(folder), fresh_presses(films, drawn[0], 100, seed=5)
    check_golden(model)
    contact = films.fold(drawn[0]).predict(presses.charge_pC)[0]
    served = np.stack(Predictor(folder).predict_batch(presses.charge_pC), axis=1)
    np.testing.assert_allclose(served[:, :3], contact, rtol=1e-4, atol=1e-4)
    assert model.metadata.made_with["command"] == "test"
    assert model.metadata.dataset_sha256 == films.sha256
    assert model.metadata.sensor["film"]["pretension_MPa"] == pytest.approx(1e-6 * drawn[0][0])
    assert (folder / "card.md").read_text() == "# mine\n"
    with pytest.raises(OutputExists):
        write_film_model(films, drawn[1], tmp_path / "mine", card="")


def test_the_served_graph_is_that_of_one_film(films, drawn, tmp_path):
    """Node for node, size for size the graph of the model that was trained on the film as described: the same speed."""
    folder = write_film_model(films, drawn[2], tmp_path / "mine", card="")
    released = Path(__file__).parents[3] / "models" / "four-25um-biaxial" / "1" / "model.onnx"
    mine, today = (onnx.load(path).graph for path in (folder / "model.onnx", released))
    assert [node.op_type for node in mine.node] == [node.op_type for node in today.node]
    assert [list(c.dims) for c in mine.initializer] == [list(c.dims) for c in today.initializer]


def test_a_folder_of_another_layout_is_refused(films, random_films, drawn, tmp_path):
    write_film_model(films, drawn[0], tmp_path / "mine", card="")
    three, _, _ = random_films(load_sensor("three-25um-biaxial"))
    with pytest.raises(ModelError, match="other than one with the electrodes"):
        write_film_model(three, three.prior.mean, tmp_path / "mine", card="", version=2)


def test_a_film_outside_the_family_is_named(films, tmp_path):
    parameters = films.prior.mean.copy()
    parameters[0] = 2e7
    with pytest.raises(SceneError, match=r"tension .* is outside the family"):
        write_film_model(films, parameters, tmp_path / "mine", card="")
    assert not list(tmp_path.iterdir())


def test_electrodes_of_ones_own_making(random_films):
    """A described calibration, other names: the frame of the file, with the film's own deviations on top."""
    sensor = load_sensor("three-25um-biaxial")
    described = Calibration({"A": 1.3}, (5e-4, -3e-4), 0.2)
    model, inputs, parts = random_films(replace(sensor, calibration=described))
    parameters = model.prior.draw(np.random.default_rng(2), 1)[0]
    presses = fresh_presses(model, parameters, 20)
    theirs = twin(model, inputs, parts, parameters, presses.charge_pC)[0]
    np.testing.assert_allclose(model.fold(parameters).predict(presses.charge_pC)[0], theirs, rtol=1e-5, atol=2e-5)
