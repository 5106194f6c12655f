"""`serve virtual` as a user meets it: what it plays is what was pressed, a film of a seed is one draw, it cleans up."""

import re
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from boards import interrupt
from isocharge.cli.shared import virtual_sensor
from isocharge.serve import AutoParser, Port, wander
from isocharge.simulate import Circle, Domain, ForwardMap, load_sensor, virtual_film

SENSOR = "three-25um-biaxial"
DESCRIBED = load_sensor(SENSOR), Circle(1.0)
FILM_9 = virtual_film(*DESCRIBED, 9)


def small_map(sensor, _):
    """A map of the middle of the film, which is not solved: each film has charges of its own."""
    return SimpleNamespace(
        domain=Domain(3.0, (0.5, 0.5)),
        electrodes="ABC",
        charges=lambda contact: contact * [30.0, -40.0, 0.3 * sensor.film.young],
    )


@pytest.fixture(autouse=True)
def solved(monkeypatch):
    """What the commands ask for; they get a small map."""
    solved = []

    def build(sensor, probe, *, radius, force_range, executor):  # noqa: ARG001
        solved.append((sensor, probe, radius, force_range))
        return small_map(sensor, probe)

    monkeypatch.setattr(ForwardMap, "build", build)
    monkeypatch.setattr("isocharge.cli.shared.virtual_sensor.PRESSES_S", 2.0)
    return solved


@pytest.fixture
def played(run, tmp_path):
    """Play until so many frames have come since charges changed by 30 pC, the film being solved and pressed.

    Gives the values of all frames, shape (n, electrodes), pC, and the result of the command.
    """

    def play(count, *words):
        link, frames = tmp_path / "film", []
        parser = AutoParser()

        def read():
            while not link.exists():
                time.sleep(0.01)
            with Port(str(link), reconnect=True) as port:
                last = np.inf
                for chunk in port:
                    frames.extend(parser.feed(chunk.data))
                    if frames and np.abs(np.subtract(frames[-1].values, frames[0].values)).max() > 30.0:
                        last = min(last, len(frames) + count)
                    if len(frames) >= last:
                        break
            interrupt()

        reader = threading.Thread(target=read)
        reader.start()
        result = run("virtual", SENSOR, "--link", link, "--rate", 1000, *words)
        reader.join(30)
        assert not link.is_symlink()
        return np.array([frame.values for frame in frames]), result

    return play


def test_random_presses_come_after_the_time_of_rest(played, solved):
    values, result = played(300, "--noise", "clean", "--force-max", 0.5, "--rest", 1.2)
    total = values.sum(axis=1)
    assert values.shape[1] == 3
    # A busy computer may add a line about pauses, and may open the port later, so that the first frames are withheld.
    counts = re.search(
        r"^\d+ frames sent, (\d+) withheld because no program read them, 0 lost", result.stderr, re.MULTILINE
    )
    rest_frames = int(np.argmax(np.abs(total - total[0]) > 1e-3))
    assert rest_frames > 100
    assert rest_frames + int(counts[1]) >= 1100  # the parser keeps the first frames while it recognises the format
    assert total.max() - total[0] > 300.0
    assert result.stdout.startswith("/dev/")
    assert solved == [(*DESCRIBED, 8.0, (0.05, 0.5))]


@pytest.mark.parametrize("frames", ["binary", "json"])
def test_virtual_option_film_plays_a_random_film_without_printing_it(played, tmp_path, frames):
    """A script: half a second without touch, then one press that is held."""
    script = tmp_path / "held.toml"
    script.write_text("presses = [[0, 0, 0, 0], [0.5, 0, 0, 0], [0.501, 1, 2, 0.5], [2, 1, 2, 0.5]]\n")
    values, result = played(100, "--script", script, "--noise", "clean", "--film", 9, "--frames", frames)
    expected_pC = small_map(*FILM_9).charges(np.array([[1.0, 2.0, 0.5]]))[0]
    np.testing.assert_allclose(values[-1, -3:] - values[0, -3:], expected_pC, rtol=1e-3)
    assert f"playing film 9 of {SENSOR} at 1000 Hz" in result.stderr


def test_frames_with_the_faults_of_a_script(played, tmp_path):
    script = tmp_path / "play.toml"
    script.write_text("[faults]\nlose_share = 0.05\ncorrupt_share = 0.001\n")
    values, result = played(700, "--script", script)
    assert values.shape == (len(values), 3)
    lost, damaged = map(int, re.search(r"(\d+) lost and (\d+) damaged on purpose", result.stderr).groups())
    assert lost > 20
    assert damaged > 0


def test_virtual_solves_the_film_only_up_to_the_scripted_distance_and_force(tmp_path, run, solved):
    (tmp_path / "far.toml").write_text("presses = [[0, 0, 0, 0], [1, 0, 0, 0], [2, 5, 12, 1], [4, 5, 12, 0]]\n")
    for words in ((), ("--radius", 15), ("--script", tmp_path / "far.toml"), ("--force-max", 1.5)):
        run("virtual", "four-25um-biaxial-15mm", "--seconds", 0.001, *words)  # the small map may not reach so far
    assert [round(radius, 3) for _, _, radius, _ in solved] == [8.0, 15.0, 13.0, 8.0]
    np.testing.assert_allclose([max_N for *_, (_, max_N) in solved], [0.8, 0.8, 1.0, 1.5], rtol=1e-5)


def test_random_presses_stay_below_the_yield_point_of_the_film_by_default(monkeypatch):
    """A probe of 1 mm radius yields the built-in films at 0.87 N."""
    assert wander(seed=1).contact[:, 2].max() <= 0.8
    domain = Domain(8.0, (0.05, 2.0))
    forward_map = SimpleNamespace(domain=domain, electrodes=("A",), charges=lambda contact: 100.0 * contact[:, 2:])
    played_scripts = []
    monkeypatch.setattr(virtual_sensor, "VirtualSensor", lambda _, script, **__: played_scripts.append(script))
    virtual_sensor.virtual_sensor(forward_map)
    assert 0.05 < played_scripts[0].contact[:, 2].max() <= 0.8


def test_charges_below_the_smallest_force_follow_the_power_law_of_a_membrane():
    """An eighth of its smallest force is a quarter of the charge: force to the 2/3."""
    linear = SimpleNamespace(domain=Domain(3.0, (0.2, 1.0)), charges=lambda contact: 100.0 * contact[:, 2:])
    charges = virtual_sensor.film_charges(linear)
    assert charges(np.array([[1.0, 2.0, 0.025], [1.0, 2.0, 0.5]])) == pytest.approx(np.array([[5.0], [50.0]]))


@pytest.mark.parametrize(
    ("words", "message", "code"),
    [
        (f"{SENSOR} --seconds 0.001 --link TMP/film", "OutputExists: TMP/film is already there", 1),
        (f"{SENSOR} --seconds 0.001 --link TMP/broken", "OutputExists: TMP/broken is already there", 1),
        (f"{SENSOR} --seconds 0.001 --link TMP/no/film", "OutputError: TMP/no/film cannot be written: No such file", 1),
        ("five-25um-biaxial", "SensorError: no sensor 'five-25um-biaxial'", 2),
        (f"{SENSOR} --film 1 --probe triangle:4", "InputError: --film: expected a --probe like circle", 2),
        (f"{SENSOR} --noise loud", "InputError: noise level: expected one of", 2),
    ],
)
def test_virtual_refuses_wrong_options(refused, solved, tmp_path, words, message, code):
    """All of them before the film is solved, except a link that cannot be created."""
    (tmp_path / "film").write_text("mine")
    (tmp_path / "broken").symlink_to("nothing")
    words, message = (text.replace("TMP", str(tmp_path)) for text in (words, message))
    refused("serve", "virtual", *words.split(), message=message, code=code)
    assert len(solved) == ("/no/" in message)
    assert (tmp_path / "film").read_text() == "mine"
