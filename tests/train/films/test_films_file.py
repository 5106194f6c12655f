"""The films file: what is read is what was written; what is damaged is said."""

import io
import json
import zipfile
from contextlib import suppress

import numpy as np
import pytest

from isocharge.common.errors import ModelError
from isocharge.simulate import load_sensor, noise_model
from isocharge.simulate.sensor.film_prior import FilmSpread
from isocharge.train import read_films
from isocharge.train.films import films_file
from isocharge.train.films.films_file import FILE, films_bytes, films_from_bytes


@pytest.fixture(scope="module")
def data(random_films):
    return films_bytes(random_films(load_sensor("four-25um-biaxial"))[0])


def test_read_is_written(data, random_films):
    written, again = random_films(load_sensor("four-25um-biaxial"))[0], films_from_bytes(data, FILE)
    assert (again.prior, again.domain, again.noise) == (written.prior, written.domain, written.noise)
    for part in ("contact", "misfit"):
        weights, read = getattr(written, part).arrays, getattr(again, part).arrays
        assert weights.keys() == read.keys()
        for name, values in weights.items():
            step = np.abs(values).max(axis=-1, keepdims=True) / 2047
            assert (np.abs(read[name] - values) <= 0.51 * step).all(), name


def test_what_a_released_file_says_is_written_again(films, pytestconfig):
    """Sensor, spread, domain and noise, which the file has in m, Pa and C; and weights of twelve bits stay the same."""
    path = pytestconfig.rootpath / "models" / "four-25um-biaxial-films" / "1" / FILE
    with np.load(path) as released, np.load(io.BytesIO(films_bytes(films))) as again:
        assert json.loads(str(again["about"])) == json.loads(str(released["about"]))
        assert np.abs(again["contact.bases.1"].astype(int) - released["contact.bases.1"]).max() <= 1
    assert films.prior.spread == FilmSpread()
    assert films.prior.probe.radius == 1.0
    assert films.noise == noise_model("reference")


def test_a_missing_file_says_what_it_belongs_to(tmp_path):
    with pytest.raises(ModelError, match=r"films\.npz: cannot be read .* `isocharge train fit --films` writes it"):
        read_films(tmp_path)


@pytest.mark.parametrize("share", [0.0, 0.9999])
def test_a_torn_file_is_damaged(data, tmp_path, share):
    (tmp_path / FILE).write_bytes(data[: int(share * len(data))])
    with pytest.raises(ModelError, match=r"films\.npz: damaged"):
        read_films(tmp_path)


@pytest.mark.parametrize("place", np.random.default_rng(6).random(3).round(3))
def test_a_flipped_byte_is_seen(data, place):
    """Every byte that matters: what is read is refused, or is the same."""
    torn = bytearray(data)
    torn[int(place * len(torn))] ^= 0x55
    with suppress(ModelError):
        read, expected = films_from_bytes(bytes(torn), FILE), films_from_bytes(data, FILE)
        layers = (each.fold(each.prior.mean).layers.hidden[1][0] for each in (read, expected))
        np.testing.assert_array_equal(*layers)


def altered(data, **changes):
    """The file with some arrays replaced or (None) left out, under its old checksum or a new one."""
    with np.load(io.BytesIO(data)) as file:
        arrays = {name: file[name] for name in file.files if name != "sha256"}
    arrays = {name: value for name, value in (arrays | changes).items() if value is not None}
    buffer = io.BytesIO()
    np.savez(buffer, **arrays, sha256=np.array(films_file._checksum(arrays)))
    return buffer.getvalue()


def test_another_format_is_named(data):
    with np.load(io.BytesIO(data)) as file:
        about = json.loads(str(file["about"]))
    newer = altered(data, about=np.array(json.dumps(about | {"format": 2})))
    with pytest.raises(ModelError, match="format 2 is not supported"):
        films_from_bytes(newer, FILE)


@pytest.mark.parametrize(
    "changes",
    [
        {"mean": np.zeros(3)},
        {"whitening": np.zeros((4, 3))},
        {"contact.skip": None},
        {"contact.skip": np.zeros((2, 2), np.int16)},
        {"family.modes": None},
        {"about": np.array("[]")},
    ],
    ids=str,
)
def test_what_does_not_fit_together_is_damaged(data, changes):
    with pytest.raises(ModelError, match=r"films\.npz: damaged"):
        films_from_bytes(altered(data, **changes), FILE)


def test_no_pickle_is_loaded():
    """A file that carries code is refused, not run."""
    buffer = io.BytesIO()
    np.savez(buffer, about=np.array([print], dtype=object), sha256=np.array(""))
    with pytest.raises(ModelError, match="damaged"):
        films_from_bytes(buffer.getvalue(), FILE)
    assert zipfile.is_zipfile(io.BytesIO(buffer.getvalue()))
