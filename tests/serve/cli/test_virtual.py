"""`serve virtual` as a user meets it: what it plays is felt, a film of a seed is one draw, and it cleans up."""

import json
import re
import signal

import numpy as np
import pytest

from isocharge.common.errors import InputError, OutputExists, SensorError
from isocharge.serve import BinaryParser, Port
from isocharge.simulate import Circle, ForwardMap, load_sensor, virtual_film


def test_virtual_sensor_plays_and_cleans_up(start, tmp_path):
    link = tmp_path / "film"
    process = start("virtual", "three-25um-biaxial", "--link", link, "--noise", "clean", "--force-max", "0.5")
    url = process.stdout.readline().strip()
    assert str(link.readlink()) == url
    parser, frames = BinaryParser(), []
    with Port(str(link)) as port:
        for chunk in port:
            frames += parser.feed(chunk.data)
            if len(frames) > 300:
                break
    assert {len(frame.values) for frame in frames} == {3}
    assert max(sum(frame.values) for frame in frames) > 300.0
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert (process.returncode, link.is_symlink()) == (0, False)
    assert "frames sent, " in err.splitlines()[-1]


def test_virtual_sensor_for_a_time(start):
    process = start("virtual", "three-25um-biaxial", "--seconds", "0.3", "--rate", "100")
    out, err = process.communicate(timeout=60)
    assert (process.returncode, out.startswith("/dev/")) == (0, True)
    assert 25 < int(err.splitlines()[-1].split()[0]) < 100


def test_virtual_sensor_does_not_overwrite(tmp_path, run):
    taken = tmp_path / "film"
    taken.write_text("mine")
    with pytest.raises(OutputExists, match="film: the path exists already"):
        run("virtual", "three-25um-biaxial", "--link", taken, "--seconds", "0")
    assert taken.read_text() == "mine"


def test_virtual_sensor_that_is_unknown(run):
    with pytest.raises(SensorError):
        run("virtual", "five-25um-biaxial")


def test_scripted_presses_as_text_are_felt(start, tmp_path, run):
    link = tmp_path / "film"
    script = tmp_path / "play.toml"
    script.write_text("presses = [[0, 0, 0, 0], [1.2, 0, 0, 0], [1.3, 1, 2, 0.5], [9, 1, 2, 0.5]]\n")
    words = ["--link", link, "--frames", "teleplot", "--script", script, "--force-max", "0.5", "--noise", "clean"]
    process = start("virtual", "three-25um-biaxial", *words)
    process.stdout.readline()
    result = run("stream", "three-25um-biaxial", "--port", link, "--count", 400)
    last = json.loads(result.stdout.splitlines()[-1])
    assert (last["x_mm"], last["y_mm"], last["force_N"]) == pytest.approx((1.0, 2.0, 0.5), abs=0.05)


def test_presses_beyond_the_usual_radius(start, tmp_path, run):
    """A script may go as far as it says."""
    link, script = tmp_path / "film", tmp_path / "play.toml"
    script.write_text("presses = [[0, 14, 0, 0], [1.2, 14, 0, 0], [1.3, 14, 0, 0.5], [9, 14, 0, 0.5]]\n")
    model, words = "four-25um-biaxial-15mm", ["--link", link, "--force-max", "0.5", "--noise", "clean"]
    process = start("virtual", model, "--script", script, *words)
    process.stdout.readline()
    last = json.loads(run("stream", model, "--port", link, "--count", 300).stdout.splitlines()[-1])
    assert (last["x_mm"], last["y_mm"], last["force_N"]) == pytest.approx((14.0, 0.0, 0.5), abs=0.1)


@pytest.mark.parametrize(
    ("words", "radius_mm"),
    [((), 8.0), (("--radius", 15), 15.0), (("--script", "far.toml"), 13.0), (("--film", 1), 8.0)],
)
def test_a_virtual_film_is_solved_as_far_as_it_is_pressed(tmp_path, monkeypatch, words, radius_mm, run):
    def build(*_, radius, **__):
        raise InputError(f"asked for {radius:.3f} mm")

    (tmp_path / "far.toml").write_text("presses = [[0, 5, 12, 0], [1, 5, 12, 0], [2, 5, 12, 1], [4, 5, 12, 0]]\n")
    monkeypatch.setattr(ForwardMap, "build", build)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=f"asked for {radius_mm:.3f} mm"):
        run("virtual", "four-25um-biaxial-15mm", *words)


HELD = "presses = [[0, 0, 0, 0], [0.5, 0, 0, 0], [0.501, 1, 2, 0.5], [60, 1, 2, 0.5]]\n"
"""A script: half a second without touch, then one press that is held."""


def held_charge_pC(start, folder, sensor, film):
    """The touch charges of HELD that the command plays, pC, and what it says on stderr."""
    link, script = folder / f"film{film}", folder / "held.toml"
    script.write_text(HELD)
    words = ["--link", link, "--script", script, "--force-max", "0.5", "--noise", "clean", "--film", film]
    process = start("virtual", sensor, *words)
    process.stdout.readline()
    parser, frames = BinaryParser(), []
    with Port(str(link)) as port:
        for chunk in port:
            frames += parser.feed(chunk.data)
            if len(frames) > 250:
                break
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=20)
    values = np.array([frame.values for frame in frames])
    rest = values[values.sum(axis=1) < values.sum(axis=1).mean()]
    return values[-1] - rest[0], err


def charge_of_film_pC(sensor, seed):
    """The same from a forward map of the film that the seed draws."""
    film, probe = virtual_film(load_sensor(sensor), Circle(1.0), seed)
    forward_map = ForwardMap.build(film, probe, 3.0, (0.2, 0.5))
    return forward_map.charges(np.array([[1.0, 2.0, 0.5]]))[0]


def test_virtual_film_plays_the_charges_of_its_film_and_does_not_tell_it(start, tmp_path):
    """Seed 9 draws a rather slack film, which is solved in the shortest time."""
    sensor = "three-25um-biaxial"
    charge_pC, err = held_charge_pC(start, tmp_path, sensor, 9)
    np.testing.assert_allclose(charge_pC, charge_of_film_pC(sensor, 9), rtol=2e-3)
    described = ForwardMap.build(load_sensor(sensor), Circle(1.0), 3.0, (0.2, 0.5))
    described_pC = described.charges(np.array([[1.0, 2.0, 0.5]]))[0]
    assert np.abs(charge_pC / described_pC - 1.0).max() > 0.02
    first, last = err.splitlines()
    assert first == "playing film 9 of three-25um-biaxial at 200 Hz; Ctrl-C stops"
    assert re.fullmatch(r"\d+ frames sent, \d+ withheld because no program read them, 0 lost and 0 .*", last)


@pytest.mark.slow
def test_a_seed_is_a_film(start, tmp_path):
    sensor = "four-25um-biaxial"
    charges = []
    for run_number, film in enumerate((3, 3, 4)):
        folder = tmp_path / str(run_number)
        folder.mkdir()
        charges.append(held_charge_pC(start, folder, sensor, film)[0])
        np.testing.assert_allclose(charges[-1], charge_of_film_pC(sensor, film), rtol=2e-3)
    np.testing.assert_array_equal(charges[0], charges[1])
    assert np.abs(charges[2] / charges[0] - 1.0).max() > 0.05


def test_virtual_film_of_a_seed_is_one_draw(monkeypatch, run):
    """What the command solves: the same for the same seed, another for another, the described without one."""
    solved = []

    def build(sensor, probe, **_):
        solved.append((sensor, probe))
        raise InputError("not solved in this test")

    monkeypatch.setattr(ForwardMap, "build", build)
    for words in ((), ("--film", 3), ("--film", 3, "--seed", 8), ("--film", 4)):
        with pytest.raises(InputError, match="not solved"):
            run("virtual", "four-25um-biaxial", "--probe", "circle:1.5", *words)
    described = load_sensor("four-25um-biaxial"), Circle(1.5)
    assert solved[0] == described
    assert solved[1] == solved[2] == virtual_film(*described, 3)
    assert solved[3] == virtual_film(*described, 4) != solved[1]


@pytest.mark.parametrize("probe", ["rectangle:4x2", "triangle:4"])
def test_virtual_film_needs_a_round_probe(probe, run):
    with pytest.raises(InputError, match=f"--film: expected a round --probe like circle:1.0.*got '{probe}'"):
        run("virtual", "three-25um-biaxial", "--film", 1, "--probe", probe)


def test_virtual_sensor_of_described_frames_with_faults(start, tmp_path, run):
    link, device = tmp_path / "film", tmp_path / "board.toml"
    device.write_text(
        '[frames]\nformat = "described"\nsync = "AA 55"\nlength = 14\nchecksum = "crc-16/x-25"\nfields = [\n'
        '{name = "seq", type = "u16"}, {name = "t_ms", type = "u16"},\n'
        '{name = "A", type = "i16", scale = 0.1}, {name = "B", type = "i16", scale = 0.1},'
        '{name = "C", type = "i16", scale = 0.1}]\n'
    )
    script = tmp_path / "play.toml"
    script.write_text("[faults]\nlose_share = 0.05\ncorrupt_share = 0.001\nunplug_every_s = 1.4\n")
    words = ["--link", link, "--device", device, "--script", script, "--force-max", "0.5"]
    process = start("virtual", "three-25um-biaxial", *words)
    process.stdout.readline()
    result = run("stream", "three-25um-biaxial", "--port", link, "--device", device, "--seconds", 3)
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    came_back = sum("reconnected" in line["flags"] for line in lines)
    assert 1 <= came_back <= 2
    assert f"{came_back} reconnects" in result.stderr.splitlines()[-1]
    assert any("gap" in line["flags"] for line in lines)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert "damaged on purpose" in err.splitlines()[-1]
    assert not link.is_symlink()
