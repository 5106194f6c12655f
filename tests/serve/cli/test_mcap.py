"""`serve stream --output touch.mcap` and the same of `serve replay`: the
lines on stdout, in a file that other tools open.

`serve plot`: a recording becomes a picture, whatever it holds.
"""

import json
import re
import shutil

import numpy as np
import pytest
from mcap.reader import make_reader

from isocharge.cli.serve import plot
from isocharge.serve import Recorder


def lines_in(path):
    with path.open("rb") as file:
        messages = make_reader(file, validate_crcs=True).iter_messages("/isocharge/record")
        data = [message.data for _, _, message in messages]
    # A string of ROS 2 begins with 8 bytes, and ends with a zero byte.
    return [(each if each.startswith(b"{") else each[8:-1]).decode() for each in data]


@pytest.mark.parametrize("name", ["touch.mcap", "touch.ros2.mcap"])
def test_replay_converts_an_old_recording(command, recorded, models, tmp_path, name):
    (recording, printed), path = recorded, tmp_path / name
    words = ["--models", models, "--output", "json", "--output", path]
    code, out, _ = command("serve", "replay", recording, *words)
    assert (code, out) == (0, printed)
    assert lines_in(path) == out.splitlines()
    assert sorted(each.name for each in tmp_path.iterdir()) == sorted([name, "touch.rec"])
    code, out, err = command("serve", "replay", recording, *words)
    assert (code, out, f"OutputExists: {path} is already there" in err) == (1, "", True)


@pytest.fixture
def figures(monkeypatch):
    """The figures that are drawn from now on."""
    figures, save = [], plot.save_picture
    monkeypatch.setattr(plot, "save_picture", lambda figure, path: figures.append(figure) or save(figure, path))
    return figures


def test_plot_draws_a_recording(command, refused, recorded, tmp_path, figures):
    picture, (path, _) = tmp_path / "touch.png", recorded
    refused("serve", "plot", path, "-o", tmp_path / "no/a.png", message="no/a.png cannot be written", code=1)
    figures.clear()
    file = shutil.copy(path, tmp_path / r"a$\frac$.rec")  # matplotlib reads formulas between dollars
    code, out, err = command("serve", "plot", file, "-o", picture)
    assert (code, out, f"drawn in {picture}: 300 records" in err) == (0, "", True), err
    assert picture.exists()

    records = [json.loads(line) for line in path.read_text().splitlines() if line.startswith('{"timestamp"')]
    lines = {line.get_label(): line.get_ydata() for axes in figures[0].axes for line in axes.lines}
    x_mm, x_std_mm, force_N, charge_C_pC = np.array(
        [
            (record["x_mm"], record["x_std_mm"], record["force_N"], (record["charge_pC"] or {"C": None})["C"])
            for record in records
        ],
        dtype=float,
    ).T
    for name, values in {"x": x_mm, "force": force_N, "C": charge_C_pC}.items():
        np.testing.assert_array_equal(lines[name], values)
    _, position_axes, _, flag_axes = figures[0].axes
    for line, stds in zip(position_axes.lines[1:3], (-2.0, 2.0), strict=True):
        np.testing.assert_allclose(line.get_ydata(), x_mm + stds * x_std_mm)
    words = [label.get_text() for label in flag_axes.get_yticklabels()]
    for flag, marks in zip(words, flag_axes.lines, strict=True):
        times_s = [record["timestamp"] - records[0]["timestamp"] for record in records if flag in record["flags"]]
        np.testing.assert_allclose(marks.get_xdata(), times_s)
    assert set(words) == {flag for record in records for flag in record["flags"]}


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([], "expected at least one record, got none"),
        (['{"timestamp": 1.0}'], "line 2: damaged .*key 't_device_us' is missing"),
    ],
)
def test_plot_refuses_empty_and_damaged_recordings(command, tmp_path, lines, message):
    path, picture = tmp_path / "touch.rec", tmp_path / "touch.png"
    with Recorder(path, "linear/1", {}):
        pass
    path.write_text(path.read_text() + "".join(f"{line}\n" for line in lines))
    code, _, err = command("serve", "plot", path, "-o", picture)
    assert (code, picture.exists()) == (2, False)
    assert re.search(message, err)
