"""A tiny fit end to end: it learns, goes on where it was stopped, and leaves a folder that serves."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.progress import listening
from isocharge.common.resumable_run import resume_parts
from isocharge.serve import Predictor, check_golden, load_model
from isocharge.train import FilmsConfig, fit_films, read_films, release_films
from isocharge.train.films import films_data
from isocharge.train.films import fit as films_fit
from isocharge.train.films import release as films_release
from isocharge.train.films.fit import films_identity
from isocharge.train.films.release import evaluate_films
from isocharge.train.training import descent

TINY = FilmsConfig(
    hidden=(24, 24), misfit_hidden=(16, 16), films=48, presses=32, watched=8, steps=300, misfit_films=3,
    misfit_charges=24, near_films=4, misfit_steps=40, batch_films=16, batch_presses=32,
)  # fmt: skip
SHORT = replace(TINY, films=16, presses=16, watched=4, steps=30, misfit_films=2, misfit_charges=8, near_films=2)


@pytest.fixture
def solved(films, monkeypatch):
    """The solves are those of a released network: the tests of the simulator cover how they come about."""

    class Solved(films_fit.FilmFamily):
        @classmethod
        def build(cls, prior, radius, force_range, executor=None):  # noqa: ARG003
            assert radius > 8.0 + 1.0
            return films.family

    monkeypatch.setattr(films_fit, "FilmFamily", Solved)
    monkeypatch.setattr(films_release, "FILMS", 4)
    monkeypatch.setattr(films_data, "CANDIDATES", 64)


@pytest.mark.usefixtures("solved")
def test_a_tiny_fit_end_to_end(films, tmp_path):
    network = fit_films(films.prior, TINY)
    released = release_films(network, tmp_path / "tiny-films", command="a command")
    model = load_model(released.folder)
    check_golden(model)
    assert model.metadata.made_with["command"] == "a command"
    assert model.metadata.made_with["config"]["radius_mm"] == 8.0
    assert len(Predictor(released.folder).predict([100.0, 90.0, 80.0, 70.0])) == 7
    trained = read_films(released.folder)
    assert evaluate_films(trained, 6, 64).known["position_rms_mm"] < 1.5  # of 4.6 mm by chance
    card = (released.folder / "card.md").read_text()
    assert "`model.onnx` is that plain model for the film" in card
    assert f"| position, rms | {model.metadata.made_with['films']['position_rms_mm']:g} mm |" in card


@pytest.mark.usefixtures("solved")
def test_a_stopped_fit_goes_on_with_the_same_weights(films, tmp_path, monkeypatch):
    monkeypatch.setattr(descent, "SAVE_EVERY_S", 0.0)
    monkeypatch.setattr(descent, "REPORT_EVERY", 10)
    identity = films_identity(films.prior, SHORT)

    class Stop(Exception):
        pass

    def stop(title, done, *_):
        if title == "training the contact network" and done == 20:
            raise Stop

    with pytest.raises(Stop), listening(stop), resume_parts(tmp_path / "it", identity) as run:
        fit_films(films.prior, SHORT, run=run)
    with resume_parts(tmp_path / "it", identity) as run:
        again = fit_films(films.prior, SHORT, run=run)
    straight = fit_films(films.prior, SHORT)
    for part in ("contact", "misfit"):
        for name, values in getattr(straight, part).arrays.items():
            np.testing.assert_array_equal(getattr(again, part).arrays[name], values)


def test_the_film_that_is_assumed_has_the_lower_error(films):
    """`model.onnx` is folded for the film that errs least over all films when none is known."""
    errors = evaluate_films(films, 6, 64)
    assert np.array_equal(errors.parameters, films.prior.mean)
    assert not np.array_equal(films.prior.mean, films.prior.described)
    assert errors.known["position_rms_mm"] < 0.5 * errors.unknown["position_rms_mm"]


def test_errors_are_those_of_the_definition(films, monkeypatch):
    """One film by hand, without noise."""
    clean = replace(films, noise=replace(films.noise, white=0.0, gain=0.0))
    (parameters,) = clean.prior.draw(np.random.default_rng(films_release.SEED), 1)
    contacts = []
    draw = films_release.draw_contacts
    monkeypatch.setattr(films_release, "draw_contacts", lambda *a: contacts.append(draw(*a)) or contacts[-1])
    errors = evaluate_films(clean, 1, 50).known
    contact = clean.fold(parameters).predict(clean.forward_map(parameters).charges(contacts[0]))[0]
    square = ((contact - contacts[0])[:, :2] ** 2).sum(axis=1)
    assert errors["position_rms_mm"] == pytest.approx(np.sqrt(square.mean()), rel=1e-3)
    assert errors["position_rms_worst_film_mm"] == errors["position_rms_mm"]
