"""`serve stream --output touch.mcap` and the same of `serve replay`: the
lines on stdout, in a file that other tools open.

`serve plot`: a recording becomes a picture, whatever it holds.
"""

import errno
import json
import os
import re

import numpy as np
import pytest
from matplotlib.image import imread
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from isocharge.cli.serve import plot
from isocharge.serve import Chunk, Recorder


def messages(path):
    with path.open("rb") as file:
        topics = {}
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            topics.setdefault(channel.topic, []).append(message)
    return topics


def lines_in(path):
    return [message.data.decode() for message in messages(path)["/isocharge/record"]]


@pytest.mark.parametrize("name", ["touch.mcap", "touch.ros2.mcap"])
def test_replay_converts_an_old_recording(command, recorded, models, tmp_path, name):
    (recording, printed), path = recorded, tmp_path / name
    words = ["--models", models, "--output", "json", "--output", path]
    code, out, _ = command("serve", "replay", recording, *words)
    assert (code, out) == (0, printed)
    if name == "touch.mcap":
        assert lines_in(path) == out.splitlines()
    else:
        ros = get_typestore(Stores.ROS2_JAZZY)
        with Reader(path) as reader:
            topic = [each for each in reader.connections if each.topic == "/isocharge/record"]
            lines = [ros.deserialize_cdr(data, each.msgtype).data for each, _, data in reader.messages(topic)]
        assert lines == out.splitlines()
    assert sorted(each.name for each in tmp_path.iterdir()) == sorted([name, "touch.rec"])
    before = path.read_bytes()
    code, out, err = command("serve", "replay", recording, *words)
    assert (code, out, f"OutputExists: {path} is already there" in err) == (1, "", True)
    assert path.read_bytes() == before


def test_a_live_stream_that_is_stopped_ends_its_file(board_until, models, run, tmp_path):
    path = tmp_path / "touch.mcap"
    with board_until(400) as board:
        out = run(
            "stream", "linear", "--port", board.url, "--models", models, "--output", "json", "--output", path
        ).stdout
    assert lines_in(path) == out.splitlines() != []


def test_full_disk_ends_the_conversion_of_a_file(command, frames, models, tmp_path, monkeypatch):
    path, os_write = tmp_path / "touch.mcap", os.write

    def write(descriptor, data):
        if descriptor > 2 and len(data) > 100:  # the file, after its header
            raise OSError(errno.ENOSPC, "No space left on device")
        return os_write(descriptor, data)

    monkeypatch.setattr("os.write", write)
    code, _, err = command("serve", "stream", "linear", "--port", frames, "--models", models, "--output", path)
    assert code == 1
    assert f"{path} cannot be written: No space left on device" in err
    assert not path.exists()


@pytest.fixture
def figures(monkeypatch):
    """The figures that are drawn from now on."""
    figures, save = [], plot.save_picture
    monkeypatch.setattr(plot, "save_picture", lambda figure, path: figures.append(figure) or save(figure, path))
    return figures


def records_in(path):
    records = map(json.loads, path.read_text().splitlines())
    return [record for record in records if "timestamp" in record]


def film_of(figure):
    return next(axes for axes in figure.axes if axes.get_xlabel() == "x, mm")


def bands_of(figure):
    """Times and values that are drawn, shape (n, 2), by label; a line is a band of no height."""
    bands = (band for axes in figure.axes for band in axes.collections if band.get_label()[0] != "_")
    return {band.get_label(): np.concatenate([path.vertices for path in band.get_paths()]) for band in bands}


def test_plot_draws_a_recording(command, recorded, models, tmp_path, figures):
    picture, (path, _) = tmp_path / "touch.png", recorded
    code, out, err = command("serve", "plot", path, "--models", models, "-o", picture)
    expected_messages = (
        f"drawn in {picture}: 300 records",
        "drawn without electrodes",
    )  # the sensor of this model has none
    assert (code, out, all(words in err for words in expected_messages)) == (0, "", True), err
    pixels = imread(picture)
    assert pixels.shape[0] > 900
    assert pixels.std() > 0.1
    records, lines = records_in(path), {name: band[:, 1] for name, band in bands_of(figures[0]).items()}
    contacts = [record for record in records if record["contact"]]
    assert np.max(lines["force"]) == max(record["force_N"] for record in records)
    assert np.min(lines["x"]) == min(record["x_mm"] for record in contacts)
    assert np.max(lines["C"]) == max(r["charge_pC"]["C"] for r in records if r["charge_pC"])
    drawn = [
        [y.min(), y.max()]
        for band in next(axes for axes in figures[0].axes if axes.get_ylabel().startswith("position")).collections
        for y in [np.concatenate([path.vertices for path in band.get_paths()])[:, 1]]
    ]
    expected = [  # two standard deviations, and the line
        [end(r[name] + sign * k * r[std] for r in contacts) for end, sign in ((min, -1.0), (max, 1.0))]
        for name, std in (("x_mm", "x_std_mm"), ("y_mm", "y_std_mm"))
        for k in (2.0, 0.0)
    ]
    np.testing.assert_allclose(drawn, expected)
    axes = next(axes for axes in figures[0].axes if axes.get_xlabel().startswith("time since"))
    for word, bars in zip(axes.get_yticklabels(), axes.collections, strict=True):
        begin, low, width, height = np.array([bar.get_extents().bounds for bar in bars.get_paths()]).T
        at, y = records[0]["timestamp"], word.get_position()[1]
        flagged = [(record["timestamp"] - at, y) for record in records if word.get_text() in record["flags"]]
        np.testing.assert_allclose(np.column_stack([begin, low + 0.5 * height]), flagged, atol=1e-6)
        least, most = np.array([1e-3, 1e-2]) * (records[-1]["timestamp"] - at)
        assert least < width.min() <= width.max() < most  # a single frame is seen, and is one
    assert {flag for record in records for flag in record["flags"]} == {
        word.get_text() for word in axes.get_yticklabels()
    }
    places = [np.asarray(points.get_offsets()) for points in film_of(figures[0]).collections]
    path_mm = next(offsets for offsets in places if len(offsets) == len(contacts))
    np.testing.assert_allclose(path_mm, [(record["x_mm"], record["y_mm"]) for record in contacts])


def test_plot_of_a_long_recording_shows_every_peak(command, recorded, models, tmp_path, monkeypatch, figures):
    monkeypatch.setattr("isocharge.cli.serve.plot.MAX_GROUPS", 32)
    assert command("serve", "plot", recorded[0], "--models", models, "-o", tmp_path / "touch.png")[0] == 0
    records = records_in(recorded[0])
    force, charge = (bands_of(figures[0])[name][:, 1] for name in ("force", "C"))
    assert len(force) < 150
    assert (force.min(), force.max()) == (0.0, max(record["force_N"] for record in records))
    assert charge.max() == max(r["charge_pC"]["C"] for r in records if r["charge_pC"])


def test_plot_draws_the_film_of_a_released_model_and_omits_an_unknown_film(command, recorded, tmp_path, figures):
    words = ("serve", "plot", recorded[0], "-o")
    code, _, err = command(*words, tmp_path / "touch.svg", "--model", "four-25um-biaxial")
    assert (code, "without" in err) == (0, False)
    assert {"A", "B", "C", "D"} <= {text.get_text() for text in film_of(figures[0]).texts}
    code, _, err = command(*words, tmp_path / "touch.png")
    assert (code, "drawn without the film, whose model is not available: no model 'linear/1'" in err) == (0, True)


def test_plot_of_a_recording_without_a_touch(command, models, tmp_path):
    path, rest = tmp_path / "rest.rec", {"x_mm": None, "y_mm": None, "force_N": 0.0}
    rest |= dict.fromkeys(("x_std_mm", "y_std_mm", "force_std_N", "misfit", "charge_pC", "charge_raw_pC"))
    with Recorder(path, "linear/1", "every", {}) as recorder:
        recorder.chunk(Chunk(b"", 1e9, 0, 0.0), [json.dumps({"timestamp": 1e9, "latency_us": 1.0, "flags": []} | rest)])
    assert command("serve", "plot", path, "--models", models, "-o", tmp_path / "rest.png")[0] == 0


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "expected at least one record, got none"),
        (['{"timestamp": 1.0}'], "line 2: damaged .*key 'x_mm' is missing"),
        (["nonsense", "{}"], "line 2: damaged"),
    ],
)
def test_plot_refuses_empty_and_damaged_recordings(command, tmp_path, lines, message):
    path, picture = tmp_path / "touch.rec", tmp_path / "touch.png"
    with Recorder(path, "linear/1", "every", {}):
        pass
    path.write_text(path.read_text() + "".join(f"{line}\n" for line in lines))
    code, _, err = command("serve", "plot", path, "-o", picture)
    assert (code, picture.exists()) == (2, False)
    assert re.search(message, err)


def test_plot_breaks_lines_at_gaps_of_the_recording(command, recorded, models, tmp_path, figures):
    """An hour without records is no straight line."""
    path, _ = recorded
    lines = path.read_text().splitlines()
    later = [json.loads(line) for line in lines[1:]]
    for entry in later:
        if "timestamp" in entry:
            entry["timestamp"] += 3600.0
    path.write_text("\n".join([*lines, *map(json.dumps, later), ""]))
    assert command("serve", "plot", path, "--models", models, "-o", tmp_path / "touch.png")[0] == 0
    colours = [points.get_array() for points in film_of(figures[0]).collections if points.get_array() is not None]
    bars = [
        bar.get_extents().x1 for axes in figures[0].axes[:4] for bars in axes.collections for bar in bars.get_paths()
    ]
    length = float(figures[0].get_suptitle().split(" in ")[1].split()[0])
    latest = [np.max(times) for times in (bands_of(figures[0])["force"][:, 0], *colours, bars, length)]
    assert latest == pytest.approx([60.0] * 4, abs=1.0)
    force = next(b for axes in figures[0].axes for b in axes.collections if b.get_label() == "force")
    assert len(force.get_paths()) == 2
