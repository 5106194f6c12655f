"""Commands: help, exit codes, data on stdout, messages on stderr, and no incomplete output files."""

import io
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from isocharge.cli.demo import live_film
from isocharge.cli.demo.command import demo_command
from isocharge.cli.demo.full_demo import run_demo
from isocharge.cli.shared import terminal
from isocharge.common.errors import InputError
from isocharge.common.progress import report, track
from isocharge.common.toml_text import to_toml
from isocharge.serve import find_model, load_model
from isocharge.simulate import ForwardMap, Resolution, SolveSettings, Sweep, load_sensor
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from kept import ROOT
from whole_films import build_from_default_map

SENSOR = "three-25um-biaxial"


def sensor_file(folder):
    path = folder / "mine.toml"
    path.write_text(to_toml(sensor_to_dict(load_sensor(SENSOR)) | {"name": "mine"}))
    return path


def point(command, *words):
    """Return the JSON of `simulate point`, and its stderr."""
    code, out, err = command("simulate", "point", *words, "--json")
    assert code == 0
    return json.loads(out), err


def test_a_point(command):
    """The command prints a table that begins with the charges, and JSON with all numbers."""
    answer, _ = point(command, SENSOR, "--probe", "circle:1.0", "--at", "0,0", "--force", "1")
    assert answer["deflection_mm"] == pytest.approx(2.812061, rel=1e-4)  # collocation, tests/data/film_cases.json
    assert answer["charge_pC"]["A"] == pytest.approx(848, rel=1e-3)
    assert (next(iter(answer)), answer["status"]) == ("charge_pC", "converged")
    assert answer["estimated_error"] < 1e-3
    assert ["MPa" in warning for warning in answer["warnings"]] == [True]
    code, out, err = command("simulate", "point", SENSOR, "--at", "3,-2", "--force", "0.5")
    assert (code, err) == (0, "")
    assert re.search(r"charge_pC +A [0-9.]+\n", out)


def test_simulate_point_reports_the_side_force_and_the_friction_of_a_vertical_stage(command):
    press = (SENSOR, "--at", "3,-4", "--force", "0.5")
    plain, _ = point(command, *press)
    pulled, _ = point(command, *press, "--side-force", "-0.06,0.08")
    rubbed, _ = point(command, *press, "--friction", "0.2")
    assert "side_force_N" not in plain
    assert rubbed["side_force_N"] == pytest.approx([-0.06, 0.08])
    assert rubbed["charge_pC"] == pytest.approx(pulled["charge_pC"], rel=1e-6)
    assert rubbed["charge_pC"]["A"] != pytest.approx(plain["charge_pC"]["A"], rel=0.005)


SMALL = ["simulate", "sweep", SENSOR, "--radius", "3", "--force", "1", "1"]
"""A sweep of a small family."""

WITHOUT_SOLVES = """
from isocharge.cli.main import main
from isocharge.simulate.dataset import sweep
from whole_films import build_from_default_map

sweep.ForwardMap.build = build_from_default_map
sweep.outside_map = sweep.yield_force = lambda *_, **__: None
sweep._shard_size = lambda *_: 500
main()
"""
"""Program of the command with a solved map, small shards, and no presses outside the radius."""


def test_a_stopped_sweep_leaves_no_file_and_no_process(tmp_path):
    """The command and its workers get SIGTERM at the first of many shards, as from a service manager."""
    process = subprocess.Popen(
        [sys.executable, "-c", WITHOUT_SOLVES, *SMALL, "--samples", "20000", "--workers", "2", "-o", "presses"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT / "tests")},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert ends(lambda: not list(tmp_path.glob(".*.draft/shard-00000.npz")))
    os.killpg(process.pid, signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert process.returncode not in (0, None)
    assert "Traceback" not in err
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ProcessLookupError):
        ends(lambda: os.killpg(process.pid, 0) is None)  # no process of the session is left


def ends(is_so):
    """Return whether a condition becomes false within two minutes."""
    for _ in range(6000):
        if not is_so():
            return True
        time.sleep(0.02)
    return False


def test_sweep_writes_its_presses_and_warns_of_the_stress(command, tmp_path, monkeypatch):
    monkeypatch.setattr(ForwardMap, "build", build_from_default_map)
    monkeypatch.setattr("isocharge.simulate.dataset.sweep.outside_map", lambda *_, **__: None)
    words = ["--samples", 300, "--orientation", "random", "--workers", 1]
    code, _, err = command(*SMALL, *words, "-o", tmp_path / "presses")
    assert code == 0
    assert f"300 presses in {tmp_path / 'presses'}" in err
    assert "caution: 1 N under circle:1.0 stress the film to 48.9 MPa at the centre, the limit is 45 MPa" in err


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_progress_bar_says_how_far_and_how_long(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv("TERM", "xterm")
    with terminal.shown_progress():
        for done in range(1, 4):
            report("solving", done, 3)
        for done in range(0, 60, 10):
            report("pressing", done, 100, "slowly")
            time.sleep(0.05)
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", sys.stderr.getvalue())
    assert "solving" in shown
    assert re.search(r"pressing .*50% 0:00:0.*slowly", shown)


def test_a_long_computation_has_a_line_every_five_seconds(monkeypatch, capsys):
    """Each step takes 3 s."""
    now_s = [0.0]
    monkeypatch.setattr(terminal.time, "monotonic", lambda: now_s[0])
    with terminal.shown_progress():
        for _ in track(range(7), "pressing"):
            now_s[0] += 3.0
    assert capsys.readouterr().err.splitlines() == ["pressing: 2 of 7", "pressing: 4 of 7", "pressing: 6 of 7"]


def test_a_thick_film(command, tmp_path):
    """Bending is computed. Other theories are computed if the user chooses them, and the command prints a warning."""
    path = sensor_file(tmp_path)
    path.write_text(path.read_text().replace("thickness_um = 25.0", "thickness_um = 1000.0"))
    answer, _ = point(command, path, "--at", "3,-2")
    assert (answer["theory"], answer["warnings"]) == ("nonlinear membrane + bending", [])
    answer, message = point(command, path, "--theory", "nonlinear membrane")
    assert answer["estimated_error"] is None
    assert "caution: a nonlinear membrane does not describe this film at all" in message


def test_a_point_warns_and_adds_a_temperature_step(command, tmp_path):
    path = sensor_file(tmp_path)
    path.write_text(re.sub(r"pyro_uC_per_m2_K = [0-9.]+", "pyro_uC_per_m2_K = -30.0", path.read_text()))
    cold, message = point(command, path, "--force", 2.0)
    warm, warm_message = point(command, path, "--force", 2.0, "--temperature", 0.1)
    assert "caution: the film is stressed to" in message
    assert warm["charge_pC"]["B"] - cold["charge_pC"]["B"] == pytest.approx(-27.0)
    assert "--temperature" not in warm_message
    path.write_text(path.read_text().replace("pyro_uC_per_m2_K = -30.0", ""))
    without_pyro, _ = point(command, path, "--temperature", 0.1)
    assert "--temperature changes no charge" in without_pyro["warnings"][-1]


def test_temperature_step_changes_the_stress_that_a_static_pressure_causes(command, tmp_path, monkeypatch):
    """A slack film that bulges under 10 Pa is cooled by 1 K. Its pretension alone changes the charge by 65.5 pC."""
    path = sensor_file(tmp_path)
    properties = "[film]\nstatic_pressure_Pa = 10.0\nexpansion_ppm_per_K = 100.0"
    path.write_text(path.read_text().replace("[film]", properties))
    coarse = SolveSettings(resolution=Resolution(4, 8, 4))
    monkeypatch.setattr("isocharge.cli.simulate.point.SolveSettings", lambda **_: coarse)
    cooled, _ = point(command, path, "--force", 1e-3, "--temperature", -1.0)
    assert cooled["charge_pC"]["B"] == pytest.approx(30.28, rel=0.02)


@pytest.mark.slow
def test_fit_says_folds_and_prints_json(command, tmp_path, monkeypatch):
    """The map of three electrodes on a uniaxial film folds within 8 mm. The command prints a warning."""
    (tmp_path / "quick.toml").write_text(
        "[network]\nhidden = [24, 24]\nmisfit_hidden = [24, 24]\n"
        "[training]\nsteps = 300\nmisfit_steps = 50\nmisfit_charges = 1000\n"
    )
    monkeypatch.chdir(tmp_path)
    _, out, err = command(
        "train", "fit", "--sensor", "three-25um-uniaxial", "--config", "quick.toml", "--json", "-o", "models/u"
    )
    assert "caution: 2 N under circle:1.0 stress the film to 74." in err
    folded = re.search(r"caution: the map from contacts to charges folds beyond ([0-9.]+) mm", err)
    assert 1.5 < float(folded[1]) < 5.0
    answer = json.loads(out)
    assert answer["errors"]["position_median_mm"] > 0.0
    assert (Path(answer["folder"]) / "card.md").is_file()


BAD = [
    ("simulate point SENSOR --force -1", "SceneError: force: expected at least 1e-12 N"),
    ("simulate point SENSOR --side-force 0.1", "InputError: --side-force: expected two numbers in N"),
    (
        "simulate point SENSOR --friction 0.1 --side-force 0.1,0",
        "InputError: --side-force and --friction: expected one of them",
    ),
    ("simulate point SENSOR --at 3", "InputError: --at: expected two numbers in mm"),
    ("simulate point SENSOR --probe cube:1", "SceneError: probe 'cube:1'"),
    ("simulate point SENSOR --temperature 1000", "sensor file holds): expected -150 to 150 K, got 1000 K"),
    ("simulate point SENSOR --force 1e308", "beyond small strains"),
    ("simulate sweep SENSOR --radius 44.5 -o OUT", "leave the film of radius 45 mm; state a smaller radius"),
    (
        "simulate sweep SENSOR --workers 2 --cluster tcp://127.0.0.1:9 -o OUT",
        "InputError: expected either --workers or --cluster, got both",
    ),
    ("simulate sweep SENSOR --radius all -o OUT", "expected a number of mm or 'auto', got 'all'"),
    ("simulate identify SENSOR --noise clean", "expected white noise above 0 pC, got that of 'clean'"),
    ("simulate identify SENSOR --error 0", "--error"),
    ("simulate sweep SENSOR --radius auto --force 0.5 0.5 -o OUT", "a smaller and a larger force"),
    ("simulate design SENSOR --electrodes 2 --radius 8 -o OUT", "three unknowns"),
    ("simulate design SENSOR --electrodes 3 --probe triangle:3 --radius 8 -o OUT", "expected circle:RADIUS"),
    ("train fit -o OUT", "InputError: expected either a DATASET folder or --sensor SENSOR"),
    (f"train fit {ROOT}/pyproject.toml -o OUT", "pyproject.toml: expected a dataset folder or a file of measured"),
    ("train fit FILE --radius 5 -o OUT", "--radius: has no effect on measured presses; leave the option out"),
    ("train fit --sensor SENSOR --force-std 0.1 -o OUT", "--force-std: has no effect on simulated presses"),
    (
        "train fit . --probe circle:1.0 -o OUT",
        "--probe: has no effect on a dataset folder; leave the option out",
    ),
    ("train fit FILE --sensor SENSOR -o OUT", "calibrate its film; use `isocharge train calibrate"),
    ("train fit --sensor SENSOR --config none.toml -o OUT", "ConfigError: none.toml: cannot be"),
    ("train fit --sensor SENSOR -o 'a b'", "ModelError: model name 'a b'"),
    (
        "train calibrate x.csv --sensor SENSOR --held-out y.csv",
        "--held-out: expected --output FOLDER for the model",
    ),
    ("train calibrate --sensor SENSOR -o OUT", "expected PRESSES.csv, or --next K"),
    ("train calibrate --sensor SENSOR --next 3 --force 2 1", "force range: expected 0 < MIN <= MAX in N, got 2 to 1"),
    ("train calibrate --sensor SENSOR --next 3 -o OUT", "--output: nothing is calibrated without PRESSES.csv"),
    ("serve bench nowhere", "ModelError: "),
    ("serve stream SENSOR --port - --follow", "expected at least four electrodes, got A, B, C"),
    (
        "serve stream four-25um-biaxial --port - --follow",
        "a film is followed from a model that `isocharge train calibrate` made",
    ),
    ("serve predict SENSOR x.csv --models nope", "ModelError: nope: expected a folder of models"),
    ("serve predict SENSOR none.csv", "ChargeError: none.csv: cannot be read"),
    ("serve predict SENSOR -", "stdin"),
]
"""Command lines and the messages with which they end with the exit code 2."""


FAILING = [
    ("simulate sweep SENSOR --samples 50 -o /proc/x", "OutputError: /proc/x cannot be written"),
    ("serve stream SENSOR --port /dev/none", "PortError"),
]
"""Command lines and the messages with which they end with the exit code 1."""


@pytest.mark.parametrize(
    ("line", "message", "code"), [*((*case, 2) for case in BAD), *((*case, 1) for case in FAILING)]
)
def test_bad_input_is_one_clear_line_and_leaves_nothing(refused, tmp_path, monkeypatch, line, message, code):
    monkeypatch.chdir(tmp_path)
    words = shlex.split(line.replace("SENSOR", SENSOR).replace("FILE", __file__))
    refused(*words, message=message, code=code)
    assert list(Path().iterdir()) == []


def test_the_demo_end_to_end(capsys, tmp_path, monkeypatch):
    """The sweep, the training and the maps are replaced. The errors are those on the card of the released model."""
    figures, released, out = [], find_model(SENSOR), tmp_path / "first-light"
    monkeypatch.setattr(ForwardMap, "build", build_from_default_map)
    for name, stub in {
        "Sweep": lambda **_: Sweep(samples=40, outside=40),
        "FOLLOWED_FRAMES": 400,
        "fit": lambda *_: None,
        "release": lambda _, folder, **__: load_model(shutil.copytree(released, folder / "1")),
        "save_picture": lambda figure, _: figures.append(figure),
        **dict.fromkeys(("press", "draw_deflection", "draw_section", "draw_charge_map"), lambda *_: None),
    }.items():
        monkeypatch.setattr(f"isocharge.cli.demo.full_demo.{name}", stub)
    run_demo(out)
    table, err = capsys.readouterr()
    assert re.findall(r"^(\d)\. (\w+): ", err, re.M) == [
        *zip("1234", ("simulate", "train", "serve", "show"), strict=True)
    ]
    model = load_model(out / "models" / SENSOR / "1")
    for name, tolerance in {"position_median_mm": 1.1, "position_p95_mm": 1.1, "force_rms_percent": None}.items():
        error, *live_error = map(float, re.findall(rf"\b{name} ([0-9.]+)", table))
        assert error == pytest.approx(model.metadata.errors[name], rel=1e-3)
        if tolerance is not None:  # live, there is one press only
            assert abs(np.log(live_error[0] / error)) < tolerance
    pressed, felt = figures[0].axes[2].lines[:2]
    assert (out / "presses").is_dir()
    np.testing.assert_allclose(felt.get_xydata(), pressed.get_xydata(), atol=0.5)


def test_playground_that_cannot_be_written_is_reported(refused, tmp_path):
    (tmp_path / "file").touch()
    refused("demo", "--playground", tmp_path / "file/a.html", message="file/a.html cannot be written", code=1)


def test_live_demo_streams_a_virtual_sensor_to_its_model(monkeypatch):
    calls = []
    board = SimpleNamespace(url="socket://127.0.0.1:1")
    monkeypatch.setattr(live_film, "ForwardMap", SimpleNamespace(build=lambda sensor, *_, **__: sensor.name))
    monkeypatch.setattr(live_film, "virtual_sensor", lambda played: nullcontext(calls.append(played) or board))
    monkeypatch.setattr(
        live_film, "stream_command", lambda *words, **options: calls.append((words, options["live"], options["token"]))
    )
    with pytest.raises(InputError, match="--live: expected PORT"):
        demo_command(live="here")
    with pytest.raises(InputError, match="expected only one of --output, --live and --playground"):
        demo_command(live="8081", output=Path("demo"))
    demo_command(live="8081", token="sesame")
    assert calls == [SENSOR, ((SENSOR, board.url), "8081", "sesame")]
