"""The network for all films, folded: equal to the conditional network, and a model like any other."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch

from isocharge.common.errors import InputError, ModelError, SceneError
from isocharge.serve import Predictor, check_golden, load_model
from isocharge.simulate import Calibration, load_sensor
from isocharge.train import Provenance, evaluate, release
from isocharge.train.training.network import MISFIT_UNIT

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
        charge = model.film(parameters).test.noisy(model.noise, seed=0)[:40]
        folded, expected = model.fold(parameters).predict(charge), by_torch(model, inputs, parts, parameters, charge)
        for mine, theirs in zip(folded, expected, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-5, atol=2e-5)


def test_the_film_matters(films, drawn):
    """On another film it answers otherwise: by far more than noise explains."""
    presses = films.film(drawn[0]).test
    right, wrong = (films.fold(parameters).predict(presses.charge)[0] for parameters in drawn[:2])
    off = [np.hypot(*(contact - presses.contact)[:, :2].T) for contact in (right, wrong)]
    assert np.median(off[1]) > 3.0 * np.median(off[0])


def test_its_intervals_hold_on_known_films(films, drawn):
    """The 95 % intervals hold 92 to 98 % of the coordinates, and the misfit is that of noise."""
    errors = [evaluate(films.film(parameters)) for parameters in drawn]
    assert 0.92 < np.mean([error["coverage_95"] for error in errors]) < 0.98
    assert np.median([error["misfit_p99"] for error in errors]) < 5.0


def test_factors_widen_the_deviations_alone(films, drawn):
    charge = films.film(drawn[0]).test.charge[:20]
    plain, wide = (films.film(drawn[0], widen=widen).predict(charge) for widen in ((1.0, 1.0), (2.0, 3.0)))
    np.testing.assert_allclose(wide[1], plain[1] * [2.0, 2.0, 3.0], rtol=1e-12)
    np.testing.assert_array_equal(wide[0], plain[0])
    np.testing.assert_array_equal(wide[2], plain[2])


@pytest.mark.parametrize(
    "parameters", [np.zeros(3), np.full(13, np.nan), np.zeros((2, 13))], ids=["few", "not finite", "two films"]
)
def test_what_is_no_film_is_refused(films, parameters):
    with pytest.raises(InputError, match=r"expected 13 finite parameters \(pretension, young"):
        films.film(parameters)


def test_a_film_outside_the_family_is_named(films):
    with pytest.raises(SceneError, match=r"tension .* is outside the family"):
        films.film(np.concatenate([[20.0], films.prior.mean[1:]]))


def test_a_film_becomes_a_served_model(films, random_films, drawn, tmp_path):
    """Its graph is node for node that of the model that was trained on the film as described: the same speed."""
    fitted = films.film(drawn[0], provenance=Provenance(files={"presses.csv": b"x_mm\n"}))
    folder = release(fitted, tmp_path / "mine", command="test", card=lambda about, _: f"# {about.name}\n").folder
    model = load_model(folder)
    check_golden(model)
    served = np.stack(Predictor(folder).predict_batch(fitted.test.charge), axis=1)
    np.testing.assert_allclose(served[:, :3], fitted.predict(fitted.test.charge)[0], rtol=1e-4, atol=1e-4)
    assert model.metadata.made_with["command"] == "test"
    assert model.metadata.dataset_sha256 == films.sha256
    assert model.metadata.sensor["film"]["pretension_MPa"] == pytest.approx(drawn[0][0])
    assert (folder / "card.md").read_text() == "# mine\n"
    assert (folder / "presses.csv").read_bytes() == b"x_mm\n"
    released = Path(__file__).parents[3] / "models" / "four-25um-biaxial" / "1" / "model.onnx"
    mine, trained = (onnx.load(path).graph for path in (folder / "model.onnx", released))
    assert [node.op_type for node in mine.node] == [node.op_type for node in trained.node]
    assert [list(c.dims) for c in mine.initializer] == [list(c.dims) for c in trained.initializer]
    three, _, _ = random_films(THREE)
    with pytest.raises(ModelError, match="other than one with the electrodes"):
        release(three.film(three.prior.mean), tmp_path / "mine", version=2)
