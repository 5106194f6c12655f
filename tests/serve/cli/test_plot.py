"""`serve plot`: a recording becomes a picture, whatever it holds."""

import json
import re

import numpy as np
import pytest
from matplotlib.image import imread

from isocharge.cli.serve import plot
from isocharge.cli.serve.pictures import recording as pictures
from isocharge.serve import Chunk, Frame, Recorder, encode_frame


@pytest.fixture
def recorded(command, film, models, tmp_path):
    """A recording of a press between two rests, with an outage of an hour."""
    rng, path, frames = np.random.default_rng(5), tmp_path / "touch.rec", tmp_path / "frames.bin"
    press = film.charge_pC([2.0], [1.0], [0.5])[0]
    rows = [rng.normal(0, 1, 3) + (press if 150 <= k < 250 else 0.0) for k in range(300)]
    frames.write_bytes(b"".join(encode_frame(Frame(k, 5000 * k, tuple(row))) for k, row in enumerate(rows)))
    command("serve", "stream", "linear", "--port", frames, "--models", models, "--record", path)
    return path


def figure_of(monkeypatch):
    """The figures that are drawn from now on."""
    figures, draw = [], pictures.recording_picture
    monkeypatch.setattr(plot, "recording_picture", lambda *words: figures.append(draw(*words)) or figures[-1])
    return figures


def test_a_recording_is_drawn(command, recorded, models, tmp_path, monkeypatch):
    figures, picture = figure_of(monkeypatch), tmp_path / "touch.png"
    code, out, err = command("serve", "plot", recorded, "--models", models, "-o", picture)
    assert (code, out) == (0, "")
    assert f"drawn in {picture}: 300 records" in err
    assert "drawn without electrodes" in err  # the sensor of this model has none
    pixels = imread(picture)
    assert pixels.shape[0] > 900
    assert pixels.std() > 0.1
    film, position, force, charge, flags = [axes for axes in figures[0].axes if axes.get_label() != "<colorbar>"]
    records = [json.loads(line) for line in recorded.read_text().splitlines()]
    records = [record for record in records if "timestamp" in record]
    lines = {line.get_label(): line.get_ydata() for axes in (position, force, charge) for line in axes.lines}
    assert np.nanmax(lines["force"]) == max(record["force_N"] for record in records)
    assert np.nanmin(lines["x"]) == min(record["x_mm"] for record in records if record["contact"])
    assert np.nanmax(lines["C"]) == max(r["charge_pC"]["C"] for r in records if r["charge_pC"])
    assert [text.get_text() for text in flags.get_yticklabels()] == sorted({f for r in records for f in r["flags"]})
    places = film.collections[-2].get_offsets()
    assert np.abs(places - [2.0, 1.0]).max() < 0.2


def test_a_long_recording_is_drawn_as_bands(command, recorded, models, tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "MOST_GROUPS", 32)
    figures, records = figure_of(monkeypatch), []
    assert command("serve", "plot", recorded, "--models", models, "-o", tmp_path / "touch.png")[0] == 0
    records = [json.loads(line) for line in recorded.read_text().splitlines() if '"timestamp"' in line]
    bands = {band.get_label(): band for axes in figures[0].axes for band in axes.collections}
    force, charge = (bands[name].get_paths()[0].vertices[:, 1] for name in ("force", "C"))
    assert len(force) < 150
    assert (force.min(), force.max()) == (0.0, max(record["force_N"] for record in records))
    assert charge.max() == max(r["charge_pC"]["C"] for r in records if r["charge_pC"])


def test_the_film_of_a_released_model(command, recorded, tmp_path, monkeypatch):
    figures = figure_of(monkeypatch)
    code, _, err = command("serve", "plot", recorded, "--model", "four-25um-biaxial", "-o", tmp_path / "touch.svg")
    assert (code, "without" in err) == (0, False)
    assert {"A", "B", "C", "D"} <= {text.get_text() for text in figures[0].axes[0].texts}


def test_without_its_model(command, recorded, tmp_path):
    code, _, err = command("serve", "plot", recorded, "-o", tmp_path / "touch.png")
    assert code == 0
    assert "drawn without the film, whose model is not to be had: no model 'linear/1'" in err


def test_nothing_touched(command, models, tmp_path):
    path, rest = tmp_path / "rest.rec", {"x_mm": None, "y_mm": None, "force_N": 0.0}
    rest |= dict.fromkeys(("x_std_mm", "y_std_mm", "force_std_N", "misfit", "charge_pC", "charge_raw_pC"))
    with Recorder(path, "linear/1", "every", {}) as recorder:
        recorder.chunk(Chunk(b"", 1e9, 0, 0.0), [json.dumps({"timestamp": 1e9, "latency_us": 1.0, "flags": []} | rest)])
    assert command("serve", "plot", path, "--models", models, "-o", tmp_path / "rest.png")[0] == 0


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([], "expected at least one record, got none"),
        (['{"timestamp": 1.0}'], "line 2: damaged .*key 'x_mm' is missing"),
        (["nonsense", "{}"], "line 2: damaged"),
    ],
)
def test_what_cannot_be_drawn(command, tmp_path, lines, said):
    path, picture = tmp_path / "touch.rec", tmp_path / "touch.png"
    with Recorder(path, "linear/1", "every", {}):
        pass
    path.write_text(path.read_text() + "".join(f"{line}\n" for line in lines))
    code, _, err = command("serve", "plot", path, "-o", picture)
    assert code == 2
    assert re.search(said, err)
    assert not picture.exists()


def test_pictures_are_not_overwritten(command, recorded, tmp_path):
    picture = tmp_path / "touch.png"
    picture.write_text("mine")
    assert command("serve", "plot", recorded, "-o", picture)[0] == 1
    assert picture.read_text() == "mine"
    assert "expected a picture's name" in command("serve", "plot", recorded, "-o", tmp_path / "touch.gif")[2]


def test_lines_break_where_nothing_came(command, recorded, models, tmp_path, monkeypatch):
    """An hour without records is no straight line."""
    figures = figure_of(monkeypatch)
    lines = recorded.read_text().splitlines()
    later = [json.loads(line) for line in lines[1:]]
    for entry in later:
        if "timestamp" in entry:
            entry["timestamp"] += 3600.0
    recorded.write_text("\n".join([*lines, *map(json.dumps, later), ""]))
    assert command("serve", "plot", recorded, "--models", models, "-o", tmp_path / "touch.png")[0] == 0
    force = next(line for axes in figures[0].axes for line in axes.lines if line.get_label() == "force")
    time = force.get_xdata()
    assert np.isnan(time).sum() == 1
    assert np.nanmax(np.diff(time[~np.isnan(time)])) > 50.0  # minutes
