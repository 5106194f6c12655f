"""The command line as a user meets it: help, exit codes, data on stdout, words on stderr, nothing half-written."""

import io
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from isocharge.cli.shared.terminal import shown_progress
from isocharge.common.progress import report
from isocharge.simulate import load_sensor
from isocharge.simulate.sensor.sensor_file import sensor_to_dict

SENSOR = "three-25um-biaxial"


def sensor_file(folder, **changes):
    table = sensor_to_dict(load_sensor(SENSOR))
    electrodes = table["electrodes"] | changes.get("electrodes", {})
    lines = ['name = "mine"', *changes.get("top", [])]
    for section in ("film", "piezo"):
        lines += [f"[{section}]", *(f"{key} = {value}" for key, value in table[section].items())]
    lines += ["[electrodes]", *(f"{key} = {value}" for key, value in electrodes.items())]
    path = folder / "mine.toml"
    path.write_text("\n".join(lines))
    return path


def test_a_point_as_json(command):
    code, out, _ = command(
        "simulate", "point", SENSOR, "--probe", "circle:1.0", "--at", "0,0", "--force", "1", "--json"
    )
    report = json.loads(out)
    assert code == 0
    assert set(report) == {
        "charge_pC",
        "deflection_mm",
        "theory",
        "status",
        "iterations",
        "residual",
        "seconds",
        "estimated_error",
        "groups",
        "warnings",
    }
    assert report["deflection_mm"] == pytest.approx(2.812061, rel=1e-4)  # collocation, tests/data/film_cases.json
    assert report["charge_pC"]["A"] == pytest.approx(848, rel=1e-3)
    assert report["status"] == "converged"
    assert report["groups"]["bending_length"] > 0.0
    assert ["MPa" in warning for warning in report["warnings"]] == [True]
    assert report["estimated_error"] < 1e-3
    assert next(iter(report)) == "charge_pC"


def test_a_point_as_a_table(command):
    code, out, err = command("simulate", "point", SENSOR, "--at", "3,-2", "--force", "0.5")
    assert code == 0
    assert "charge A" in out
    assert "pC" in out
    assert err == ""


SMALL = ["simulate", "sweep", SENSOR, "--radius", "3", "--force", "1", "1", "--samples", "34000"]
"""A sweep of a small family, in three shards: while two workers make the last, the first is there to be seen."""


@pytest.mark.parametrize(
    ("signal_name", "workers", "awaited"),
    [
        ("SIGTERM", 2, "shard-00000"),
        ("SIGINT", 2, "solve-00-0001"),
        pytest.param("SIGTERM", 1, "solve", marks=pytest.mark.slow),
        pytest.param("SIGKILL", 2, "shard", marks=pytest.mark.slow),
    ],
)
def test_a_stopped_sweep_goes_on_and_leaves_no_process(command, tmp_path, signal_name, workers, awaited):
    """Stopped as soon as a file of that name is there; the same command, with other workers, makes the same bytes."""
    process = subprocess.Popen(
        [sys.executable, "-m", "isocharge.cli", *SMALL, "--workers", str(workers), "-o", "presses"],
        cwd=tmp_path,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 100
    while not list(tmp_path.glob(f"presses.part/parts/{awaited}*.sha256")) and time.monotonic() < deadline:
        time.sleep(0.005)
    process.send_signal(getattr(signal, signal_name))
    _, err = process.communicate(timeout=60)
    assert process.returncode not in (0, None)
    assert "Traceback" not in err
    assert signal_name == "SIGKILL" or "stopped; what is done is kept in presses.part, and the same command" in err
    assert [path.name for path in tmp_path.iterdir()] == ["presses.part"]
    assert ends(lambda: os.killpg(process.pid, 0))  # no process of the session is left
    assert command(*SMALL, "--workers", 1, "-o", tmp_path / "presses")[0] == 0
    assert [path.name for path in tmp_path.iterdir()] == ["presses"]
    assert files(tmp_path / "presses") == files(whole_sweep(command, tmp_path))


def ends(signalled) -> bool:
    """Whether there is nobody to signal any more, within ten seconds."""
    for _ in range(500):
        try:
            signalled()
        except ProcessLookupError:
            return True
        time.sleep(0.02)
    return False


def whole_sweep(command, folder, known={}):  # noqa: B006
    """The same without a stop, once."""
    if not known:
        known["folder"] = folder.with_name("whole") / "presses"
        assert command(*SMALL, "--workers", 2, "-o", known["folder"])[0] == 0
    return known["folder"]


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_sweep_stopped_at_once_leaves_nothing(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "isocharge.cli", *SMALL, "--workers", "1", "-o", "presses"], cwd=tmp_path, text=True,
        stderr=subprocess.PIPE,
    )  # fmt: skip
    deadline = time.monotonic() + 60
    while not any(tmp_path.iterdir()) and time.monotonic() < deadline:
        time.sleep(0.001)
    process.terminate()
    _, err = process.communicate(timeout=60)
    assert process.returncode not in (0, None)
    assert "Traceback" not in err
    solved = list(tmp_path.glob("presses.part/parts/solve-*"))  # on a busy machine the signal may come after the first
    assert list(tmp_path.iterdir()) == [] or solved


def test_an_unfinished_sweep_of_other_settings_is_kept_unless_fresh(command, tmp_path):
    part = tmp_path / "presses.part"
    for folder in ("parts", "data"):
        (part / folder).mkdir(parents=True)
    (part / "lock").touch()
    (part / "run.json").write_text('{"sweep": {"samples": 7}}')
    code, _, err = command(*SMALL, "-o", tmp_path / "presses")
    assert code == 1
    assert "OutputExists" in err
    assert "presses.part holds the unfinished run of other settings" in err
    assert "--fresh" in err
    assert part.exists()
    words = ["--samples", 300, "--sampling", "grid", "--orientation", "random", "--workers", 1, "--fresh"]
    code, _, err = command(*SMALL, *words, "-o", tmp_path / "presses")
    assert code == 0
    assert f"293 presses in {tmp_path / 'presses'}" in err
    assert not part.exists()


def test_a_progress_bar_says_how_far_and_how_long(monkeypatch):
    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr(sys, "stderr", Terminal())
    monkeypatch.setenv("COLUMNS", "160")
    monkeypatch.setenv("TERM", "xterm")
    with shown_progress():
        for done in range(1, 4):
            report("solving", done, 3)
        for done in range(0, 60, 10):
            report("pressing", done, 100, "slowly")
            time.sleep(0.05)
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", sys.stderr.getvalue())
    assert "solving" in shown
    assert re.search(r"pressing .*50/100 .*0:00:0.*slowly", shown)


def test_progress_without_a_terminal_is_a_line_now_and_then(monkeypatch, capsys):
    clock = iter(range(100))
    monkeypatch.setattr("isocharge.cli.shared.terminal.time.monotonic", lambda: float(next(clock)))
    with shown_progress():
        for done in range(12):
            report("solving", done, 12)
    assert capsys.readouterr().err == "solving: 4 of 12\nsolving: 9 of 12\n"


def test_a_point_says_theory_groups_and_estimated_error(command, tmp_path):
    """1 mm: 3.72 pC on A, 0.139 mm deep (tests/data/film_cases.json)."""
    path = sensor_file(tmp_path)
    path.write_text(path.read_text().replace("thickness_um = 25.0", "thickness_um = 1000.0"))
    code, out, _ = command("simulate", "point", path, "--at", "3,-2", "--json")
    report = json.loads(out)
    assert code == 0
    assert report["charge_pC"]["A"] == pytest.approx(3.7150435, rel=1e-3)
    assert report["deflection_mm"] == pytest.approx(0.1391483, rel=1e-3)
    assert report["theory"] == "nonlinear membrane + bending"
    assert 0.0 < report["estimated_error"] < 1e-3
    assert report["groups"]["bending_length"] > 0.1
    assert report["warnings"] == []


def test_a_theory_that_does_not_fit_is_said_to(command, tmp_path):
    path = sensor_file(tmp_path)
    path.write_text(path.read_text().replace("thickness_um = 25.0", "thickness_um = 1000.0"))
    code, out, err = command("simulate", "point", path, "--theory", "nonlinear membrane", "--json")
    assert code == 0
    assert json.loads(out)["estimated_error"] is None
    assert "caution: a nonlinear membrane does not describe this film at all" in err
    code, out, err = command("simulate", "point", path, "--theory", "linear plate")
    assert code == 0
    assert "theory            linear plate" in out
    assert "caution: expected an error of the charges of at most 0.001" in err


def test_a_point_warns_and_adds_a_temperature_step(command, tmp_path):
    path = sensor_file(tmp_path)
    path.write_text(re.sub(r"pyro_uC_per_m2_K = [0-9.]+", "pyro_uC_per_m2_K = 30.0", path.read_text()))
    code, out, err = command("simulate", "point", path, "--force", 2.0, "--json")
    warm = json.loads(command("simulate", "point", path, "--force", 2.0, "--temperature", 0.1, "--json")[1])
    assert code == 0
    assert "caution: the film is stressed to" in err
    assert warm["charge_pC"]["B"] - json.loads(out)["charge_pC"]["B"] == pytest.approx(27.0)


@pytest.mark.slow
def test_sweep_fit_predict_one_by_one(command, tmp_path):
    presses, model, table = tmp_path / "presses", tmp_path / "models" / "mine", tmp_path / "charges.csv"
    assert command("simulate", "sweep", SENSOR, "--samples", 2000, "--radius", 5, "--workers", 2, "-o", presses)[0] == 0
    config = tmp_path / "quick.toml"
    config.write_text(
        "[network]\nhidden = [32, 32]\nmisfit_hidden = [16, 16]\n"
        "[training]\nsteps = 300\nmisfit_steps = 50\nmisfit_charges = 2000\n"
    )
    code, _, err = command("train", "fit", presses, "--config", config, "-o", model)
    assert code == 0
    assert "position error" in err
    table.write_text("A,B,C\n848,848,848\n")
    code, out, _ = command("serve", "predict", model, table)
    header, row = out.splitlines()
    assert code == 0
    assert header.startswith("x_mm,y_mm,force_N")
    assert [float(value) for value in row.split(",")[:3]] == pytest.approx([0.0, 0.0, 1.0], abs=0.3)


def test_fit_says_folds_and_prints_json(command, tmp_path):
    """Three uniaxial electrodes: the asked 8 mm are cut, and the user is told."""
    config = tmp_path / "quick.toml"
    config.write_text("[training]\nsteps = 200\nmisfit_steps = 50\nmisfit_charges = 2000\n")
    words = ("--sensor", "three-25um-uniaxial", "--config", config, "--json", "-o", tmp_path / "models" / "u")
    code, out, err = command("train", "fit", *words)
    assert code == 0
    folded = re.search(r"caution: the map from contacts to charges folds beyond ([0-9.]+) mm", err)
    assert 1.5 < float(folded[1]) < 5.0
    answer = json.loads(out)
    assert answer["errors"]["position_median_mm"] > 0.0
    card = (Path(answer["folder"]) / "card.md").read_text()
    assert f"within {folded[1]} mm of the centre (of 8 mm asked for" in card


def test_a_fit_for_other_electrodes_is_refused(command, tmp_path):
    presses, config = tmp_path / "presses", tmp_path / "four.toml"
    command("simulate", "sweep", SENSOR, "--samples", 600, "--radius", 3, "-o", presses)
    config.write_text("[network]\nelectrodes = 4\n")
    code, _, err = command("train", "fit", presses, "--config", config, "-o", tmp_path / "models" / "mine")
    assert code == 2
    assert "ConfigError: network.electrodes: the configuration is for 4 electrodes" in err
    assert not (tmp_path / "models").exists()


BAD = [
    (("simulate", "point", "no-such-sensor"), 2, "SensorError: no sensor 'no-such-sensor'"),
    (("simulate", "point", SENSOR, "--force", "-1"), 2, "SceneError: force: expected a positive number of newtons"),
    (("simulate", "point", SENSOR, "--force", "nan"), 2, "SceneError: force"),
    (("simulate", "point", SENSOR, "--at", "44.5,0"), 2, "SceneError: probe off the film: centre (44.5, 0) mm"),
    (("simulate", "point", SENSOR, "--at", "3"), 2, "InputError: --at: expected two numbers in mm"),
    (("simulate", "point", SENSOR, "--probe", "cube:1"), 2, "SceneError: probe 'cube:1'"),
    (("simulate", "point", SENSOR, "--probe", "circle:0"), 2, "SceneError: probe radius: expected a positive number"),
    (
        ("simulate", "point", SENSOR, "--probe", "rectangle:4x0"),
        2,
        "SceneError: probe height: expected a positive number",
    ),
    (("simulate", "point", SENSOR, "--theory", "magic"), 2, "SceneError: theory: expected one of"),
    (("simulate", "point", SENSOR, "--accuracy", "0"), 2, "InputError: --accuracy: expected"),
    (("simulate", "sweep", SENSOR, "--samples", "0", "-o", "OUT"), 2, "SceneError: samples: expected at least 1"),
    (
        ("simulate", "sweep", SENSOR, "--force", "2", "1", "-o", "OUT"),
        2,
        "SceneError: force: expected 0 < smallest <= largest",
    ),
    (("simulate", "sweep", SENSOR, "--radius", "44.5", "-o", "OUT"), 2, "leave the film of radius 45 mm"),
    (
        ("simulate", "sweep", SENSOR, "--workers", "2", "--cluster", "tcp://127.0.0.1:9", "-o", "OUT"),
        2,
        "InputError: expected either --workers or --cluster, got both",
    ),
    (("simulate", "sweep", SENSOR, "--cluster", "pigeon://1", "-o", "OUT"), 2, "InputError: cluster 'pigeon://1'"),
    (("simulate", "sweep", SENSOR, "--probe", "cube:1", "-o", "OUT"), 2, "SceneError: probe 'cube:1'"),
    (("train", "fit", "-o", "OUT"), 2, "InputError: expected either a DATASET folder or --sensor"),
    (("train", "fit", ".", "-o", "OUT"), 2, "DatasetError: . is not a dataset: it has no manifest.json"),
    (
        ("train", "fit", "--sensor", SENSOR, "--config", "none.toml", "-o", "OUT"),
        2,
        "ConfigError: none.toml: cannot be",
    ),
    (
        ("simulate", "point", SENSOR, "--probe", "circle:1e-30"),
        2,
        "SceneError: probe radius: expected at least 0.02 mm",
    ),
    (("simulate", "point", SENSOR, "--force", "1e6"), 2, "beyond small strains"),
    (
        ("simulate", "sweep", SENSOR, "--samples", "1000000000000", "-o", "OUT"),
        2,
        "SceneError: samples: expected at most",
    ),
    (("train", "fit", "--sensor", SENSOR, "-o", "a b"), 2, "ModelError: model name 'a b'"),
    (("simulate", "sweep", SENSOR, "--samples", "50", "-o", "/proc/x"), 1, "OutputError: /proc/x cannot be written"),
    (("serve", "predict", SENSOR, "x.csv", "--models", "nope"), 2, "ModelError: nope: expected a folder of models"),
    (("serve", "predict", "no-such-model", "x.csv"), 2, "ModelError"),
    (("serve", "predict", SENSOR, "none.csv"), 2, "InputError: none.csv: cannot be read"),
    (("serve", "stream", SENSOR, "--port", "/dev/none"), 1, "PortError"),
]


@pytest.mark.parametrize(
    ("words", "code", "message"), BAD, ids=lambda value: " ".join(value) if isinstance(value, tuple) else ""
)
def test_bad_input_is_one_clear_line_and_leaves_nothing(command, tmp_path, monkeypatch, words, code, message):
    monkeypatch.chdir(tmp_path)
    got, out, err = command(*words)
    assert (got, out) == (code, "")
    assert message in err
    assert "Traceback" not in err
    assert list(Path().iterdir()) == []


def test_an_unknown_option_is_usage(command):
    assert command("simulate", "point", SENSOR, "--no-such-option")[0] == 2


def test_an_unknown_key_in_a_sensor_file(command, tmp_path):
    path = sensor_file(tmp_path, top=['colour = "red"'])
    code, _, err = command("simulate", "point", path)
    assert code == 2
    assert f"SensorError: {path}: unknown key 'colour'" in err


def test_an_electrode_off_the_film(command, tmp_path):
    path = sensor_file(tmp_path, electrodes={"C": "[40.0, 25.0]"})
    code, _, err = command("simulate", "point", path)
    assert code == 2
    assert "electrode 'C' lies outside the film: centre (40.0, 25.0) mm" in err


def test_an_existing_output_is_kept(command, tmp_path):
    (tmp_path / "presses").mkdir()
    (tmp_path / "presses" / "mine.txt").write_text("keep me")
    code, _, err = command("simulate", "sweep", SENSOR, "--samples", 100, "-o", tmp_path / "presses")
    assert code == 1
    assert "OutputExists" in err
    assert (tmp_path / "presses" / "mine.txt").read_text() == "keep me"


def test_the_demo_end_to_end(command, tmp_path):
    """The whole path with everything in it but the long training."""
    out = tmp_path / "first-light"
    code, table, err = command("demo", "-o", out, "--seconds", 6, "--config", quick(tmp_path))
    assert code == 0
    assert (out / "demo.png").stat().st_size > 50_000
    assert (out / "presses" / "manifest.json").is_file()
    for row in ("position error", "force error", "model", "one prediction", "seconds"):
        assert row in table
    assert "0 lost, 0 repeated" in err


def quick(folder):
    path = folder / "quick.toml"
    path.write_text("[training]\nsteps = 400\nmisfit_steps = 100\nmisfit_charges = 2000\n")
    return path
