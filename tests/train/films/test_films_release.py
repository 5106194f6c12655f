"""The network for all films: a short training, its continuation after a stop, and its file."""

import io
import json
import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from isocharge.common.activations import ACTIVATIONS, Activation
from isocharge.common.errors import ModelError
from isocharge.common.progress import listening
from isocharge.common.resumable_run import resume_parts
from isocharge.serve import Predictor, check_golden, find_model, load_model
from isocharge.simulate import load_sensor, noise_model
from isocharge.simulate.sensor.film_prior import FilmSpread
from isocharge.train import FilmsConfig, fit_films, read_films, release_films
from isocharge.train.films import films_data, films_file
from isocharge.train.films import fit as films_fit
from isocharge.train.films import release as films_release
from isocharge.train.films.films_file import FILE, _npz, films_bytes, films_from_bytes
from isocharge.train.films.fit import films_identity
from isocharge.train.films.release import ROWS, FilmsErrors, evaluate_films, films_card
from isocharge.train.training import correlation, descent


@pytest.fixture(scope="module")
def data(random_films):
    return films_bytes(random_films(load_sensor("four-25um-biaxial"))[0])


def test_a_file_gives_the_written_model_back(data, random_films):
    written, _, _ = random_films(load_sensor("four-25um-biaxial"))
    read = films_from_bytes(data, FILE)
    assert read.prior == written.prior
    assert read.domain == written.domain
    assert read.noise == written.noise
    for part in ("contact", "misfit"):
        written_arrays = getattr(written, part).arrays
        read_arrays = getattr(read, part).arrays
        assert read_arrays.keys() == written_arrays.keys()
        for name, values in written_arrays.items():
            rounding_step = np.abs(values).max(axis=-1, keepdims=True) / 2047
            assert (np.abs(read_arrays[name] - values) <= 0.51 * rounding_step).all(), name


def test_a_file_keeps_the_activation(films):
    softplus = Activation("softplus", lambda x: np.logaddexp(0.0, x), "softplus", "Softplus", c_source="")
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(ACTIVATIONS, "softplus", softplus)
        contact = replace(films.contact, activation=softplus)
        misfit = replace(films.misfit, activation=softplus)
        read = films_from_bytes(films_bytes(replace(films, contact=contact, misfit=misfit)), FILE)
    assert read.contact.activation is softplus
    assert read.misfit.activation is softplus


def test_a_released_file_is_written_again_with_the_same_content(films, pytestconfig):
    """The file has other units than the program, and it rounds the weights. Neither changes the numbers."""
    path = pytestconfig.rootpath / "models" / "four-25um-biaxial-films" / "1" / FILE
    data = films_bytes(films)
    with np.load(path) as released, np.load(io.BytesIO(data)) as again:
        assert json.loads(str(again["about"])) == json.loads(str(released["about"]))
    weights = films.contact.arrays["bases.1"]
    rounding_step = np.abs(weights).max(axis=-1, keepdims=True) / 2 ** (films_file.BITS - 1)
    weights_again = films_from_bytes(data, FILE).contact.arrays["bases.1"]
    assert (np.abs(weights_again - weights) <= 0.51 * rounding_step).all()
    assert films.prior.spread == FilmSpread()
    assert films.prior.probe.radius == 1.0
    assert films.noise == noise_model("reference")


def test_the_error_of_a_missing_file_names_the_command_that_writes_it(tmp_path):
    with pytest.raises(ModelError, match=r"films\.npz: cannot be read .* `isocharge train fit --films` writes it"):
        read_films(tmp_path)


def test_a_small_file_that_unpacks_to_very_much_is_refused_before_it_is_unpacked():
    bomb = _npz({"mean": np.zeros(100 << 20, np.uint8)})
    tracemalloc.start()
    with pytest.raises(ModelError, match=r"films\.npz: damaged \(.*unpack to more than"):
        films_from_bytes(bomb, "films.npz")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(bomb) < 1 << 18
    assert peak < 50 << 20


def altered(data, **changes):
    """Return a file with a valid checksum in which some arrays are replaced, changed by a function, or left out."""
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files if name != "sha256"}
    changed = {name: change(arrays[name]) if callable(change) else change for name, change in changes.items()}
    arrays = {name: value for name, value in (arrays | changed).items() if value is not None}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays, sha256=np.array(films_file._checksum(arrays)))
    return buffer.getvalue()


def newer(about):
    return np.array(json.dumps(json.loads(str(about)) | {"format": 2}))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda _: b"", "damaged"),
        (lambda data: data[: int(0.9999 * len(data))], "damaged"),
        (lambda data: altered(data, about=newer), "format 2 is not supported"),
        *(
            (lambda data, changes=changes: altered(data, **changes), "damaged")
            for changes in (
                {"mean": np.zeros(3)},
                {"whitening": np.zeros((4, 3))},
                {"contact.skip": None},
                {"contact.skip": np.zeros((2, 2), np.int16)},
                {"family.modes": None},
                {"about": np.array("[]")},
                {"about": np.array([print], dtype=object)},  # code, which is not run
            )
        ),
    ],
)
def test_a_damaged_or_newer_file_is_refused(data, damage, message):
    with pytest.raises(ModelError, match=rf"films\.npz: .*{message}"):
        films_from_bytes(damage(data), FILE)


TINY = FilmsConfig(
    hidden=(24, 24), misfit_hidden=(16, 16), films=32, presses=32, watched=8, steps=240, misfit_films=2,
    misfit_charges=24, near_films=4, misfit_steps=40, batch_films=16, batch_presses=32,
)  # fmt: skip
SHORT = replace(TINY, films=16, presses=16, watched=4, steps=30, misfit_films=2, misfit_charges=8, near_films=2)


@pytest.fixture
def solved(films, monkeypatch):
    """Use the forward maps of a released network instead of solving new ones."""

    class Solved(films_fit.FilmFamily):
        @classmethod
        def build(cls, prior, radius, force_range, executor=None):  # noqa: ARG003
            assert radius > 8.0 + 1.0
            assert force_range[0] < 0.05 < 2.0 < force_range[1]
            return films.family

    monkeypatch.setattr(films_fit, "FilmFamily", Solved)
    monkeypatch.setattr(films_fit.FilmModes, "build", lambda *_: films.family.imperfections)
    monkeypatch.setattr(films_release, "N_FILMS", 4)
    monkeypatch.setattr(films_data, "N_CANDIDATES", 64)
    monkeypatch.setattr(correlation, "N_EXAMPLES", 1_000)


def test_the_contact_network_is_trained_at_the_configured_rate_with_clipped_gradients(random_films):
    """Large gradients of rare films are clipped. The rate is that of the settings, as for every other network."""
    model, inputs, [contact, _] = random_films(load_sensor("four-25um-biaxial"))
    presses = films_data.draw_film_presses(model.prior, model.family, model.domain, 8, 16, seed=3)
    stage = films_fit.contact_stage(contact, inputs, presses, model.noise, TINY)
    assert stage.rate_factor == 1.0
    assert stage.largest_gradient == films_fit.LARGEST_GRADIENT < np.inf
    assert 0 < stage.warm_up_steps < stage.steps == TINY.steps


@pytest.mark.usefixtures("solved")
@pytest.mark.slow
def test_a_short_training_gives_a_model_that_is_served(films, tmp_path):
    released = release_films(fit_films(films.prior, TINY), tmp_path / "tiny-films", command="a command")
    model = load_model(released.folder)
    check_golden(model)
    assert model.metadata.made_with["command"] == "a command"
    assert model.metadata.made_with["config"]["radius_mm"] == 8.0
    assert len(Predictor(released.folder).predict([100.0, 90.0, 80.0, 70.0])) == 10
    trained = read_films(released.folder)
    assert evaluate_films(trained, 6, 64).with_known_film["position_rms_mm"] < 1.5  # of 4.6 mm by chance
    card = (released.folder / "card.md").read_text()
    assert "`model.onnx` is the model of the film" in card
    assert f"| position, rms | {model.metadata.made_with['films']['position_rms_mm']:g} mm |" in card
    unnoticed = model.metadata.unnoticed
    assert unnoticed.from_mm == 8.0
    assert 0.5 < unnoticed.total_share < 1.0  # the electrodes lie on one circle
    assert "## Presses outside the working area" in card


@pytest.mark.usefixtures("solved")
@pytest.mark.slow  # in `make test`, a training of a model for one film is stopped, by the same code
def test_a_stopped_training_continues_with_the_same_weights(films, tmp_path, monkeypatch):
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


def test_the_assumed_film_has_the_lower_error(films):
    """Of the described film and the mean of the prior, the model assumes the one with the lower errors."""
    errors = evaluate_films(films, 6, 64)
    assert np.array_equal(errors.parameters, films.prior.mean)
    assert not np.array_equal(films.prior.mean, films.prior.described)
    assert errors.with_known_film["position_rms_mm"] < 0.5 * errors.with_assumed_film["position_rms_mm"]


def test_the_card_lists_the_measured_errors(films):
    about = load_model(find_model("four-25um-biaxial-films")).metadata
    known = dict.fromkeys([key for _, key, _ in ROWS], 0.25) | {"coverage_68": 0.67, "coverage_95": 0.95}
    errors = FilmsErrors(known, {key: 0.5 * value for key, value in known.items()}, about.errors, "a film")
    card = films_card(films, errors, about, SimpleNamespace(domain=films.domain))
    assert {
        "| coverage of the 68 % intervals | 67 % | 33.5 % |",
        "| coverage of the 95 % intervals | 95 % | 47.5 % |",
        "| trained for the noise | reference: 1 pC and 0.2 % |",
        "| Young's modulus; thickness | 20 %; 5 % |",
        "| d31 and d32, each; gains, each | 20 %; 5 % |",
        about.made_with["command"],
    } <= {*card.splitlines()}
    assert card.count(" | 0.25 ") == card.count(" | 0.125 ") == len(ROWS)
