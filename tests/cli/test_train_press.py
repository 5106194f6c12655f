"""`train press`: the dialogue with a list of events, and the command with a simulated board."""

import json
import os
import re
import threading
from contextlib import closing
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from tests.train.calibration.conftest import few_hypotheses, rig  # noqa: F401
from tests.train.calibration.synthetic_film import SyntheticFilm

from boards import encoded_frames
from isocharge.cli.train import calibrate as calibrate_command
from isocharge.cli.train import press as press_command
from isocharge.cli.train.press_dialogue import Dialogue, PressEvents, SessionEnd
from isocharge.common.errors import PortLost
from isocharge.serve import Chunk, PressWatch, ReadingStream, read_presses, write_presses
from isocharge.serve.live.steady_press import (
    PORT_LOST,
    Phase,
    SteadyPress,
    WatchResult,
)
from isocharge.simulate import Circle, Piezo, load_sensor
from isocharge.train import CalibrationProblem, calibrate
from isocharge.train.calibration import calibrate as calibrate_module
from isocharge.train.calibration import session as session_module

NAMES = ("A", "B", "C", "D")
RATE_HZ = 200.0


class FakeSession:
    """Plan that proposes positions one after the other, and ends after three presses."""

    summary = ("so much is known",)

    def __init__(self):
        self.taken = []
        self._place()

    def _place(self):
        self.proposed = SimpleNamespace(contact=np.array([len(self.taken), 0.0, 0.024]))
        self.presses = SimpleNamespace(contact=np.array(self.taken), electrodes=NAMES)

    def __len__(self):
        return len(self.taken)

    @property
    def enough(self):
        return len(self.taken) >= 3

    def take(self, _, contact):
        self.taken.append(tuple(contact.tolist()))
        self._place()

    def undo(self):
        self.taken.pop()
        self._place()
        return len(self.taken) + 1


class Script:
    """Source of events in a given order. A request for a further event is an error."""

    def __init__(self, *events):
        self.events, self.armed = list(events), 0

    def arm(self):
        self.armed += 1

    def next(self):
        if isinstance(event := self.events.pop(0), Exception):
            raise event
        return event


STEADY = WatchResult(Phase.taken, press=SteadyPress(np.full(4, 500.0), 0.7))
TARED = WatchResult(Phase.waiting)
HELD = WatchResult(Phase.settling)
INVERTED = WatchResult(Phase.taken, press=SteadyPress(np.full(4, -500.0), 0.7, ("negative", "gap")))


def refused(reason):
    return WatchResult(Phase.refused, reason=reason)


def dialogue(*events, contacts=None):
    """The session after a dialogue with a person, or with a machine that makes the presses of a list."""
    session, script = FakeSession(), Script(*events)
    talk = Dialogue(session, script)
    if contacts is None:
        talk.guide_person()
    else:
        talk.follow_machine(contacts)
    assert not script.events
    return session, script


def test_enter_takes_a_press_as_proposed(capsys):
    session, _ = dialogue(TARED, HELD, HELD, HELD, STEADY, "", STEADY, "1.5 2 0.9", STEADY, "? ? 0.5")
    assert session.taken[:2] == [(0.0, 0.0, 0.024), (1.5, 2.0, 0.9)]
    assert np.isnan(session.taken[2][:2]).all()
    message = capsys.readouterr().err
    assert "\n1. Press 0.024 N at (0.0, 0.0) mm and hold." in message
    assert message.count("   hold it\n") == 1
    assert re.findall(r": A (\S+),", message) == ["500.0"] * 3
    assert message.count("so much is known") == 3
    assert message.endswith("With --until 0 the same command takes more presses.\n")


FIRST = (0.0, 0.0, 0.024)


@pytest.mark.parametrize(
    ("events", "taken", "message"),
    [
        ([STEADY, "", "q"], [FIRST], "so much is known"),
        ([STEADY, "q"], [], ""),
        ([STEADY, SessionEnd()], [], ""),
        ([STEADY, "u", STEADY, "", "u", "q"], [], "press 1 is removed"),
        (["what?", STEADY, "1 2", "1 2 3", "q"], [(1.0, 2.0, 3.0)], "got '1 2'"),
        (["", STEADY, "q"], [], "press first"),
        ([INVERTED, "q"], [], "D -500.0 pC [negative, gap]"),
    ],
)
def test_what_is_typed_is_done(events, taken, message, capsys):
    assert dialogue(*events)[0].taken == taken
    assert message in capsys.readouterr().err


def test_a_press_that_is_refused_is_asked_for_again(capsys):
    session, script = dialogue(refused("it moves"), refused(PORT_LOST), STEADY, "", "q")
    assert (session.taken, script.armed) == ([FIRST], 4)
    assert "not taken: it moves; press again" in capsys.readouterr().err


LIST = np.array([[1.0, 1.0, 0.5], [2.0, 2.0, 0.5], [3.0, 3.0, np.nan]])


def test_presses_of_a_machine_are_those_of_its_list(capsys):
    session, script = dialogue(TARED, STEADY, refused("it moves"), HELD, STEADY, contacts=LIST)
    np.testing.assert_array_equal(session.taken, LIST[[0, 2]])
    message = capsys.readouterr().err
    assert script.armed == 0
    assert message.index("Let the machine begin") < message.index("1. 0.5 N")
    assert "row 2 is left out: it moves" in message


@pytest.mark.parametrize(("taken", "next_row"), [([0], 2), ([0, 1, 2], 4), ([0, 2, 0], 5)])
def test_list_that_repeats_its_presses_is_continued_at_the_next_row(taken, next_row, capsys):
    """A row that is left out before the port is lost is expected again, so the error states no other row."""
    session = FakeSession()
    session.presses = SimpleNamespace(contact=LIST[taken])
    with pytest.raises(PortLost, match="names the row"):
        Dialogue(session, Script(TARED, refused("it moves"), refused(PORT_LOST))).follow_machine([*LIST, *LIST])
    assert f"begin with row {next_row} of its list" in capsys.readouterr().err


@pytest.fixture(scope="module")
def problem():
    return CalibrationProblem(load_sensor("four-25um-biaxial"), Circle(1.0))


@pytest.fixture(scope="module")
def synthetic(problem):
    """Charges of similar films by a closed formula."""
    return SyntheticFilm(problem.prior.layout.prior, problem.solved_domain)


@pytest.fixture(scope="module")
def charges(synthetic):
    """Return the function that returns the charges of contacts on the film of a seed."""
    return partial(synthetic.charges, synthetic.prior.draw(np.random.default_rng(3), 1)[0])


PLACES = np.array([[5.0, 1.0, 0.8], [-3.0, 4.5, 0.3]])
"""Contacts that the machine presses, mm and N."""


def board(charges, places, seed=0):
    """Return the frames that a board sends while a machine presses each position for 1.2 s, every 2 s."""
    rows = np.random.default_rng(seed).normal(12.0, 1.0, (400 * (len(places) + 1), 4))  # 1 pC of noise, 12 pC of offset
    for number, charge in enumerate(charges(places), start=1):
        rows[400 * number : 400 * number + 240] += charge
    yield from encoded_frames(rows, RATE_HZ)


@pytest.fixture
def desk(charges, tmp_path, monkeypatch):
    """A folder with the bytes of a board, in two parts, and the list of the presses that it makes."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "some.bin").write_bytes(b"".join(board(charges, PLACES[:1])))
    (tmp_path / "rest.bin").write_bytes(b"".join(board(charges, PLACES[1:], seed=1)))
    np.savetxt(tmp_path / "list.csv", PLACES, fmt="%.17g", delimiter=",", header="x_mm,y_mm,force_N", comments="")
    return tmp_path


def test_a_press_that_had_begun_is_left_out_and_a_line_is_not(charges):
    """The board waits in the middle of its first press until the dialogue wants the next."""
    (reader, keyboard), armed = os.pipe(), threading.Event()

    def chunks():
        for number, data in enumerate(board(charges, PLACES)):
            if number == 440:
                armed.wait(60)
            yield Chunk(data, number / RATE_HZ, 0)

    with closing(PressEvents(chunks(), ReadingStream(NAMES), PressWatch(NAMES), reader)) as events:
        coming = iter(events.next, None)
        assert any(event.phase is Phase.settling for event in coming)
        os.write(keyboard, b"u\n")
        assert "u\n" in coming
        events.arm()
        armed.set()
        press = next(event.press for event in coming if event.press)
        with pytest.raises(SessionEnd):
            list(coming)
    np.testing.assert_allclose(press.charge_pC, charges(PLACES[1:])[0], rtol=0.01, atol=2.0)
    os.close(keyboard)


PRESS = ("train", "press", "--sensor", "four-25um-biaxial", "-o", "presses.csv")


@pytest.mark.usefixtures("few_hypotheses")
def test_presses_of_a_machine_become_a_file_that_calibrates_a_film(command, desk, charges, monkeypatch, synthetic):
    """The port ends after the first press. The same command continues with the second row of the list.

    The charges are those of a closed formula, and no film is solved.
    """
    monkeypatch.setattr(session_module, "solve_even", lambda *_: synthetic)
    monkeypatch.setattr(calibrate_module, "solve_even", lambda *_: synthetic)
    monkeypatch.setattr(calibrate_module, "SAME_FILM_STD", np.inf)
    _, _, err = command(*PRESS, "--port", "some.bin", "--press-list", "list.csv")
    assert "presses in presses.csv: 1; the same command continues the session" in err
    assert len(read_presses(desk / "presses.csv")) == 1

    problem = ("--probe", "circle:1.1", "--radius", "7.9", "--force", "0.04", "1.9")
    code, _, err = command(*PRESS, *problem, "--port", "rest.bin", "--press-list", "list.csv")
    assert code == 0, err
    assert "presses.csv has 1 presses; the session continues with them" in err
    assert f"isocharge train calibrate presses.csv --sensor four-25um-biaxial {' '.join(problem)} -o my-film" in err

    presses = read_presses(desk / "presses.csv", NAMES)
    np.testing.assert_allclose(presses.charge_pC, charges(PLACES), atol=1.0)  # 5 standard deviations of the means
    np.testing.assert_array_equal(presses.contact, PLACES)


def test_charges_of_a_film_with_negative_coefficients_may_have_any_sign(command, problem, monkeypatch):
    settings = {}
    monkeypatch.setattr(press_command, "load_sensor", lambda _: replace(problem.sensor, piezo=Piezo(-8.0, -8.0)))
    monkeypatch.setattr(press_command, "ReadingStream", lambda *_, **options: settings.update(options))
    command(*PRESS, "--port", "no_board")
    assert settings["has_any_sign"]


@pytest.mark.usefixtures("few_hypotheses")
def test_a_calibration_without_an_output_only_states_the_film(command, desk, monkeypatch, synthetic, problem):
    monkeypatch.setattr(calibrate_command, "calibrate", partial(calibrate, start=synthetic, accurate=False))
    monkeypatch.setattr(calibrate_module, "SAME_FILM_STD", np.inf)
    _, _, presses = rig(problem, synthetic, 8, seed=5)
    write_presses(desk / "presses.csv", presses)
    before = sorted(desk.iterdir())
    words = "train calibrate presses.csv --sensor four-25um-biaxial --charge-std 0.4 --json"
    code, out, err = command(*words.split())
    assert code == 0, err
    quiet = replace(problem, noise=replace(problem.noise, white=0.4))
    expected = calibrate(presses, quiet, start=synthetic, accurate=False)
    assert json.loads(out)["properties"]["pretension"]["value"] == pytest.approx(expected.film.value("pretension"))
    assert sorted(desk.iterdir()) == before


def test_a_file_with_further_columns_is_not_overwritten(refused, desk):
    text = "x_mm,y_mm,force_N,A,B,C,D,comment\n1,1,1,500,500,500,500,mine\n"
    (desk / "presses.csv").write_text(text)
    refused(*PRESS, "--port", "some.bin", "--press-list", "list.csv", message="got further columns: comment")
    assert (desk / "presses.csv").read_text() == text


@pytest.mark.parametrize(
    ("options", "message", "code"),
    [
        ("--port some.bin --press-list far.csv", "far.csv, press 2: expected a press within 8.5 mm", 2),
        ("--port some.bin --press-list half.csv", "half.csv, line 2: expected both x_mm and y_mm", 2),
        ("--port some.bin --press-list nothing.csv", "cannot be read", 2),
        ("--port some.bin --press-list list.csv -o .", "expected a file in an existing folder", 1),
        ("--port some.bin --press-list list.csv -o nowhere/presses.csv", "nowhere", 1),
        ("--port noise.bin --press-list list.csv", "no intact frame", 1),
    ],
)
def test_bad_input_is_refused_before_the_first_press(refused, desk, options, message, code):
    (desk / "far.csv").write_text("x_mm,y_mm,force_N\n1,1,1\n30,1,1\n")
    (desk / "half.csv").write_text("x_mm,y_mm,force_N\n1,,1\n")
    (desk / "noise.bin").write_bytes(bytes(range(256)) * 100)
    before = sorted(desk.iterdir())
    refused(*PRESS, *options.split(), message=message, code=code)
    assert sorted(desk.iterdir()) == before
