"""A tiny training end to end: it learns, goes on where it was stopped, and leaves a folder that serves."""

import numpy as np
import pytest

from isocharge.common.errors import OutputExists
from isocharge.serve import Predictor, check_golden, load_model
from isocharge.train import read_films, train_films
from isocharge.train.films import fit as films_fit
from isocharge.train.films import misfit_films
from isocharge.train.films import release as films_release
from isocharge.train.films.films_file import FILE
from isocharge.train.films.measure import films_errors, fresh_films
from isocharge.train.training import checkpoint


@pytest.fixture
def solved(films, monkeypatch):
    """The solves are those of a released network: the tests of the simulator cover how they come about."""

    class Solved:
        @classmethod
        def build(cls, prior, radius, force_range, **options):  # noqa: ARG003
            assert radius * 1e3 > 8.0 + 1.0
            return films.family

        from_arrays = staticmethod(films_fit.FilmFamily.from_arrays)

    monkeypatch.setattr(films_fit, "FilmFamily", Solved)
    monkeypatch.setattr(films_release, "fresh_films", lambda model: fresh_films(model, 4, 32))
    monkeypatch.setattr(misfit_films, "CANDIDATES", 64)


@pytest.mark.usefixtures("solved")
def test_a_tiny_training_end_to_end(films, tiny, tmp_path):
    seen = []
    release = train_films(
        films.prior, tmp_path / "tiny-films", tiny, command="a command", progress=lambda *now: seen.append(now)
    )
    done = [now[0] for now in seen]
    assert done == sorted(done)
    assert seen[-1][0] == seen[-1][1]
    model = load_model(release.folder)
    check_golden(model)
    assert model.metadata.made_with["command"] == "a command"
    assert len(Predictor(release.folder).predict([100.0, 90.0, 80.0, 70.0])) == 7
    trained = read_films(release.folder)
    errors = films_errors(trained, fresh_films(trained, 6, 64))
    assert errors["position_rms_mm"] < 1.5  # of 4.6 mm by chance
    card = (release.folder / "card.md").read_text()
    assert "`model.onnx` is that plain model for the film" in card
    assert f"| position, rms | {model.metadata.made_with['films']['position_rms_mm']:g} mm |" in card
    assert not list(tmp_path.glob("*/*.part"))


@pytest.mark.usefixtures("solved")
def test_a_stopped_run_goes_on_with_the_same_weights(films, tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(checkpoint, "EVERY_S", 0.1)
    straight = train_films(films.prior, tmp_path / "straight", tiny)

    class Stop(Exception):
        pass

    def stop(done, _, text):
        if "contact: " in text and done >= films_fit.FAMILY_STEPS + films_fit.PRESSES_STEPS + 200:
            raise Stop

    with pytest.raises(Stop):
        train_films(films.prior, tmp_path / "stopped", tiny, progress=stop)
    assert (tmp_path / "stopped" / "1.part").exists()
    again = train_films(films.prior, tmp_path / "stopped", tiny)
    assert (straight.folder / FILE).read_bytes() == (again.folder / FILE).read_bytes()


@pytest.mark.usefixtures("solved")
def test_an_existing_version_is_refused_before_any_work(films, tiny, tmp_path):
    (tmp_path / "tiny" / "1").mkdir(parents=True)
    with pytest.raises(OutputExists):
        train_films(films.prior, tmp_path / "tiny", tiny)


def test_the_film_that_is_assumed_has_the_lower_error(films, monkeypatch):
    """`model.onnx` is folded for the film that errs least over all films when none is told."""
    drawn = fresh_films(films, 6, 64)
    monkeypatch.setattr(films_release, "fresh_films", lambda _: drawn)
    measured = films_release._Measured.of(films)
    chosen, rival = (
        films_errors(films, drawn, parameters)["position_rms_mm"]
        for parameters in (measured.parameters, films.prior.described)
    )
    assert chosen < rival
    assert measured.known["position_rms_mm"] < 0.5 * measured.unknown["position_rms_mm"]


def test_measured_errors_are_those_of_the_definition(films):
    """One film by hand."""
    drawn = fresh_films(films, 1, 50)
    ((parameters, presses, noisy),) = drawn
    contact = films.fold(parameters).predict(noisy)[0]
    square = ((contact - presses.contact)[:, :2] ** 2).sum(axis=1)
    errors = films_errors(films, drawn)
    assert errors["position_rms_mm"] == pytest.approx(np.sqrt(square.mean()), rel=1e-3)
    assert errors["position_rms_worst_film_mm"] == errors["position_rms_mm"]
