"""Calibrating at a port: the dialogue against a list of events, and the command against a board that presses."""

import json
import os
import re
import threading
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
from tests.train.calibration.conftest import coarse  # noqa: F401  (a fixture of this module, too)

from isocharge.cli.train.press_dialogue import Dialogue, PressEvents, Screen, Stopped
from isocharge.common.errors import PortLost
from isocharge.serve import Chunk, Frame, PressWatch, ReadingStream, encode_frame, read_presses
from isocharge.serve.live.steady_press import AWAY, Phase, SteadyPress, Watched
from isocharge.simulate import Circle, load_amplifier, load_sensor
from isocharge.train import CalibrationProblem, next_presses
from isocharge.train.calibration.folder import SESSION

NAMES = ("A", "B", "C", "D")
RATE_HZ = 200.0


class FakeSession:
    """Proposes places one after the other, and knows enough after three presses."""

    summary = ("so much is known",)

    def __init__(self):
        self.taken, self.skips = [], 0
        self._place()

    def _place(self):
        self.proposed = SimpleNamespace(contact=np.array([len(self.taken) + self.skips / 10, 0.0, 1.0]))
        self.presses = SimpleNamespace(contact=np.array(self.taken))

    def __len__(self):
        return len(self.taken)

    @property
    def enough(self):
        return len(self.taken) >= 3

    def take(self, _, contact):
        self.taken.append(tuple(contact.tolist()))
        self._place()

    def undo(self, number):
        self.taken.pop(-1 if number == "last" else number - 1)
        self._place()
        return len(self.taken) + 1 if number == "last" else number

    def skip(self):
        self.skips += 1
        self._place()


class Script:
    """Events in their order; those that are not asked for are an error."""

    def __init__(self, *events):
        self.events, self.armed = list(events), 0

    def arm(self):
        self.armed += 1

    def next(self):
        if isinstance(event := self.events.pop(0), Exception):
            raise event
        return event


STEADY = Watched(Phase.taken, press=SteadyPress(np.full(4, 500.0), np.ones(4), np.ones(4), 0.7, 0.5, 100, ()))
TARED = Watched(Phase.waiting, np.zeros(4))
HELD, LATER, LATE = (Watched(Phase.settling, np.full(4, 400.0), held_s) for held_s in (0.3, 0.8, 1.4))


def refused(reason):
    return Watched(Phase.refused, reason=reason)


def dialogue(*events, asks=True, contacts=None):
    """The session after a dialogue with a person, or with a machine that makes the presses of a list."""
    session, script, taken = FakeSession(), Script(*events), []
    talk = Dialogue(session, script, Screen(NAMES), lambda *_: taken.append(len(session)))
    if contacts is None:
        talk.with_person(asks=asks)
    else:
        talk.with_machine(contacts)
    assert not script.events
    return session, script, taken


def test_enter_takes_a_press_as_proposed(capsys):
    session, _, taken = dialogue(TARED, HELD, LATER, LATE, STEADY, "", STEADY, "1.5 2 0.9", STEADY, "? ? 0.5")
    assert session.taken[:2] == [(0.0, 0.0, 1.0), (1.5, 2.0, 0.9)]
    assert np.isnan(session.taken[2][:2]).all()
    assert taken == [1, 2, 3]
    said = capsys.readouterr().err
    assert "\n1. Press 1.00 N at (0.0, 0.0) mm and hold." in said
    assert "hold it, 0.3 s: A 400.0, B 400.0, C 400.0, D 400.0 pC" in said
    assert ("0.8 s" in said, "hold it, 1.4 s" in said) == (False, True)  # one line a second
    assert re.findall(r": A (\S+),", said) == ["400.0"] * 2 + ["500.0"] * 3
    assert said.count("so much is known") == 3
    assert said.endswith("The film is known well enough; --until 0 goes on.\n")


FIRST, SECOND, THIRD = ((float(x), 0.0, 1.0) for x in range(3))


@pytest.mark.parametrize(
    ("events", "taken", "said"),
    [
        ([STEADY, "", "q"], [FIRST], "so much is known"),
        ([STEADY, "q"], [], ""),
        ([STEADY, Stopped()], [], ""),
        ([Stopped()], [], ""),
        ([STEADY, "u", STEADY, "", "u", "q"], [], "press 1 is taken back"),
        ([STEADY, "", STEADY, "u 1", "", "q"], [SECOND], "press 1 is taken back"),
        (["s", STEADY, "s", STEADY, "", "q"], [(0.2, 0.0, 1.0)], "(0.2, 0.0) mm"),
        (["what?", STEADY, "1 2", "1 2 3", "q"], [(1.0, 2.0, 3.0)], "got '1 2'"),
        (["", STEADY, "q"], [], "press first"),
    ],
)
def test_what_is_typed_is_done(events, taken, said, capsys):
    assert dialogue(*events)[0].taken == taken
    assert said in capsys.readouterr().err


def test_a_press_that_is_refused_is_asked_for_again(capsys):
    session, script, _ = dialogue(refused("it moves"), refused(AWAY), STEADY, "", "q")
    assert (session.taken, script.armed) == ([FIRST], 4)
    assert "not taken: it moves; press again" in capsys.readouterr().err


def test_nothing_is_asked_with_yes():
    assert dialogue(STEADY, STEADY, STEADY, asks=False)[0].taken == [FIRST, SECOND, THIRD]


LIST = np.array([[1.0, 1.0, 0.5], [2.0, 2.0, 0.5], [3.0, 3.0, np.nan]])


def test_presses_of_a_machine_are_those_of_its_list(capsys):
    session, script, _ = dialogue(TARED, STEADY, refused("it moves"), HELD, STEADY, contacts=LIST)
    np.testing.assert_array_equal(session.taken, LIST[[0, 2]])
    said = capsys.readouterr().err
    assert script.armed == 0
    assert said.index("let the machine begin") < said.index("1. 0.50 N")
    assert "row 2 is left out: it moves" in said


def test_a_port_that_goes_away_under_a_machine_ends_the_session():
    with pytest.raises(PortLost, match="go on with row 2 of its list"):
        dialogue(TARED, STEADY, refused(AWAY), contacts=LIST)


@pytest.fixture(scope="module")
def problem():
    return CalibrationProblem.of(load_sensor("four-25um-biaxial"), Circle(1.0))


@pytest.fixture(scope="module")
def film(problem):
    """A film that a seed draws."""
    return problem.charges.forward_map(problem.prior.draw(np.random.default_rng(3), 1)[0])


@pytest.fixture(scope="module")
def places(problem):
    return np.array([press.contact for press in next_presses(problem, 3)])


def board(film, places, seed=0) -> Iterator[bytes]:
    """Frames of a machine that presses at places for 1.2 s each, through an amplifier."""
    t = np.arange(round(1.2 * RATE_HZ)) / RATE_HZ
    rise = np.clip(np.minimum(t, 1.2 - t) / 0.1, 0.0, 1.0)[:, None] ** (2 / 3)
    pause = np.zeros((round(0.8 * RATE_HZ), 4))
    pieces = [np.zeros((400, 4))]
    for charge in film.charges(places):
        pieces += [rise * charge, pause]
    measure = load_amplifier("reference").start(4, RATE_HZ, np.random.default_rng(seed))
    for k, row in enumerate(measure(np.concatenate(pieces))):
        yield encode_frame(Frame(k, round(1e6 * k / RATE_HZ), tuple(row + 12.0)))


@pytest.fixture
def desk(film, places, tmp_path, monkeypatch):
    """A folder with the bytes of a board, in two parts, and the list of the presses that it makes."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "some.bin").write_bytes(b"".join(board(film, places[:2])))
    (tmp_path / "rest.bin").write_bytes(b"".join(board(film, places[2:], seed=1)))
    np.savetxt(tmp_path / "list.csv", places, fmt="%.17g", delimiter=",", header="x_mm,y_mm,force_N", comments="")
    return tmp_path


def test_a_press_that_had_begun_is_left_out_and_a_line_is_not(film, places):
    """The board waits in the middle of its first press until the dialogue wants the next."""
    (reader, keyboard), armed = os.pipe(), threading.Event()

    def chunks():
        for number, data in enumerate(board(film, places[:2])):
            if number == 440:
                armed.wait(60)
            yield Chunk(data, number / RATE_HZ, 0)

    with PressEvents(chunks(), ReadingStream(NAMES), PressWatch(NAMES), reader) as events:
        coming = iter(events.next, None)
        assert any(event.phase is Phase.settling for event in coming)
        os.write(keyboard, b"u 1\n")
        assert "u 1\n" in coming
        events.arm()
        armed.set()
        press = next(event.press for event in coming if event.press)
        with pytest.raises(Stopped):
            list(coming)
    np.testing.assert_allclose(press.charge_pC, film.charges(places[1:2])[0], rtol=0.01, atol=2.0)
    os.close(keyboard)


CALIBRATE = ("train", "calibrate", "--sensor", "four-25um-biaxial", "-o", "film")


def test_presses_of_a_machine_calibrate_a_film(command, desk, film, places):
    """The port ends after two presses; the same command goes on with the third row."""
    _, _, err = command(*CALIBRATE, "--port", "some.bin", "--press-list", "list.csv")
    assert "2 presses are in film/presses.part.csv; the same command goes on with them" in err
    assert len(read_presses(desk / "film" / SESSION)) == 2
    code, out, err = command(*CALIBRATE, "--port", "rest.bin", "--press-list", "list.csv", "--json")
    assert (code, "going on with 2 presses" in err) == (0, True)
    *lines, end = map(json.loads, out.splitlines())
    assert [(line["press"], line["problem"], line["next"]) for line in lines] == [
        (3, None, None)
    ]  # a machine asks for none
    clean = film.charges(places)
    taken = read_presses(desk / "film/1/presses.csv", NAMES)
    assert [[line["charge_pC"][name] for name in NAMES] for line in lines] == taken.charge_pC[2:].tolist()
    assert (np.abs(taken.charge_pC - clean) < 5 * np.hypot(1.0, 0.002 * clean) * np.sqrt(1 / 90 + 1 / 50)).all()
    assert lines[-1]["error_left"] == end["error_left"]
    assert not (desk / "film" / SESSION).exists()
    np.testing.assert_array_equal(taken.contact, places)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "or --from FOLDER with --temperature C, got none of them"),
        (["list.csv", "--temperature", "nan"], "--temperature: expected -100 to 200 degrees Celsius, got nan"),
        (["--from", "film", "--temperature", "23", "--port", "some.bin"], "--temperature: presses from --port"),
        (["--next", "2"], "nothing is calibrated without PRESSES.csv"),
        (["list.csv", "--probe", "triangle:4.0"], "expected a round one"),
        (["metres.csv"], "were they written in metres"),
        (["--port", "some.bin", "list.csv"], "leave out PRESSES.csv, --next"),
        (["--press-list", "list.csv"], "belong to --port"),
        (["--port", "some.bin", "--press-list", "far.csv"], "far.csv, press 2: expected a press within 9"),
        (["--port", "some.bin", "--press-list", "half.csv"], "half.csv, line 2: expected both x_mm and y_mm"),
        (["--port", "some.bin", "--press-list", "nothing.csv"], "cannot be read"),
        (["--port", "noise.bin", "--press-list", "list.csv"], "no intact frame"),
    ],
)
def test_what_cannot_be_is_said_before_the_first_press(refused, desk, words, message):
    (desk / "far.csv").write_text("x_mm,y_mm,force_N\n1,1,1\n30,1,1\n")
    (desk / "metres.csv").write_text("x_mm,y_mm,force_N,A,B,C,D\n0.001,0,1,9,8,7,6\n0,0.002,1,9,8,7,6\n")
    (desk / "half.csv").write_text("x_mm,y_mm,force_N\n1,,1\n")
    (desk / "noise.bin").write_bytes(bytes(range(256)) * 100)
    refused(*CALIBRATE, *words, said=message, code=1 if "noise.bin" in words else 2)
    assert not (desk / "film").exists()
