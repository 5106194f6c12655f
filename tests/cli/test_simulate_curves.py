"""The commands for curves, contours and the paper: JSON, tables, pictures, refusals."""

import json
import sys

import numpy as np
import pytest

from isocharge.cli.main import main

SENSOR = "three-25um-biaxial"


@pytest.fixture
def command(monkeypatch, capsys):
    """Run `isocharge simulate ...` in this process: (exit code, stdout, stderr)."""

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["isocharge", "simulate", *map(str, words)])
        with pytest.raises(SystemExit) as done:
            main()
        out, err = capsys.readouterr()
        return int(done.value.code or 0), out, err

    return run


@pytest.fixture(scope="module", autouse=True)
def _quick():
    """One forward map for all commands: what it holds is tested elsewhere."""
    from isocharge.simulate import ForwardMap, Resolution, SolveSettings, Theory

    build, made = ForwardMap.build.__func__, {}

    def once(cls, sensor, probe, radius, _forces, *, progress=None):
        if not made:
            membrane = Theory(stretching=True, bending=False, pretensioned=False)
            resolution = Resolution(4, 8, 5)
            made[None] = build(
                cls, sensor, probe, 14e-3, (1.0, 1.0), settings=SolveSettings(theory=membrane, resolution=resolution)
            )
        assert radius <= 14e-3
        progress(1, 1)
        return made[None]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ForwardMap, "build", classmethod(once))
        yield


def test_curves_as_json(command):
    code, out, err = command("curves", SENSOR, "--from", "A", "--angles", 35, 90, "--length", 12, "--json")
    report = json.loads(out)
    assert (code, err) == (0, "")
    assert [line["angle_deg"] for line in report["lines"]] == pytest.approx([35, 45, 55, 65, 75, 85, 90])
    line = report["lines"][-1]
    assert line["distance_mm"] == pytest.approx([4.0, 8.0, 12.0])
    assert line["y_mm"] == pytest.approx([-6.0, -2.0, 2.0])
    assert set(line["charge_pC"]) == {"A", "B", "C"}
    assert np.all(np.diff(line["charge_pC"]["A"]) < 0.0)


def test_curves_as_a_table_and_a_picture(command, tmp_path):
    picture = tmp_path / "curves.svg"
    code, out, err = command("curves", SENSOR, "--from", "B", "--length", 12, "-o", picture)
    assert code == 0
    assert out.startswith("charge of B, pC")
    assert len(out.splitlines()) == 2 + 15
    assert str(picture) in err
    assert "distance from the centre of B, mm" in picture.read_text()


def test_contours_of_a_charge_as_json(command):
    code, out, _ = command("contours", SENSOR, "--charge", "A=900", "--charge", "B=9000", "--radius", 6, "--json")
    report = json.loads(out)
    assert code == 0
    first, second = report["contours"]
    assert (first["electrode"], first["charge_pC"], len(first["pieces_mm"])) == ("A", 900.0, 1)
    assert np.shape(first["pieces_mm"][0])[1] == 2
    assert second["pieces_mm"] == []
    low, high = report["reached_pC"]["B"]
    assert 0.0 < low < high < 9000.0


def test_a_charge_that_no_contour_reaches_is_said(command):
    code, out, _ = command("contours", SENSOR, "--charge", "B=9000", "--radius", 3)
    assert code == 0
    assert "no contour: within 3 mm it has" in out


def test_contours_of_a_press_meet_there(command, tmp_path):
    picture = tmp_path / "contours.png"
    words = ("contours", SENSOR, "--at=2,-3", "--radius", 5, "-o", picture)
    code, out, _ = command(*words, "--json")
    meeting = json.loads(out)["meeting"]
    assert code == 0
    assert meeting["status"] == "met"
    assert meeting["at_mm"] == pytest.approx([2.0, -3.0], abs=2e-3)
    assert picture.read_bytes().startswith(b"\x89PNG")
    code, _, err = command(*words)
    assert code == 1
    assert "already there" in err


def test_levels_by_default(command):
    code, out, _ = command("contours", SENSOR, "--levels", 2, "--radius", 3)
    assert code == 0
    assert [line.split()[0] for line in out.splitlines()] == ["A", "A", "B", "B", "C", "C"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("curves", SENSOR, "--from", "E"), "no electrode 'E' on three-25um-biaxial: it has A, B, C"),
        (("curves", SENSOR, "--angles", 90, 35), "expected MIN <= MAX, got 90 to 35 degrees"),
        (("curves", SENSOR, "-o", "curves.txt"), "expected a picture's name ending in png, svg, pdf"),
        (("contours", SENSOR, "--charge", "E=900"), "no electrode 'E'"),
        (("contours", SENSOR, "--charge", "A=much"), "expected an electrode and pC like 'A=650', got 'A=much'"),
        (("contours", SENSOR, "--charge", "A=nan"), "expected an electrode and pC like 'A=650', got 'A=nan'"),
        (("contours", SENSOR, "--charge", "A=900", "--at", "1,1"), "either --charge or --at, got both"),
        (("contours", SENSOR, "--at", "here"), "expected two numbers in mm"),
    ],
)
def test_wrong_input_ends_with_2_and_shows_it(command, words, message):
    code, out, err = command(*words)
    assert code == 2
    assert out == ""
    assert message in err


def test_the_paper_is_not_written_over(command, tmp_path):
    code, out, err = command("paper", "-o", tmp_path)
    assert (code, out) == (1, "")
    assert "already there" in err


def test_the_paper_prints_its_numbers(command, tmp_path, monkeypatch):
    """The command hands over what it was asked for; the page itself is made in tests/simulate/test_paper.py."""
    asked = {}

    def write(output, choices, crew, **progress):
        asked.update(choices=choices, progress=set(progress), workers=crew.executor)
        output.mkdir()
        (output / "paper.json").write_text('{"Fig. 1": {}}\n')

    monkeypatch.setattr("isocharge.simulate.paper.write_paper", write)
    code, out, err = command("paper", "-o", tmp_path / "new", "--workers", 1, "--quick", "--json")
    assert code == 0
    assert json.loads(out) == {"Fig. 1": {}}
    assert "paper.md" in err
    assert asked["choices"].presses < 100
    assert asked["progress"] == {"solved", "triangulated", "drawn"}
    assert asked["workers"] is None
