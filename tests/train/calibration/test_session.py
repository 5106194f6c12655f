"""Tests of a session of presses: proposals, saving before the fit, undo, skip, bad presses, and typed answers."""

import numpy as np
import pytest
from tests.benchmarks.measured_films import measured_presses

from isocharge.common.errors import PressError
from isocharge.serve import MeasuredPresses
from isocharge.train import PressSession, next_presses
from isocharge.train.calibration import session as session_module
from isocharge.train.calibration.session import read_answer


class ExactRig:
    """A film drawn from the prior, a rig without errors, and a session of presses.

    Attributes:
        session: The session.
        saved: Presses that the session has saved, in the order of the changes.
    """

    def __init__(self, problem, synthetic, plan, count=0):
        """Begin a session, or continue one with the first `count` presses of a plan."""
        (self.values,) = problem.prior.layout.prior.draw(np.random.default_rng(5), 1)
        self.charges = synthetic
        self.saved: list[MeasuredPresses] = []
        contact = np.array([press.contact for press in plan[:count]])
        presses = measured_presses(problem, contact, synthetic.charges(self.values, contact)) if count else None
        self.session = PressSession(problem, save=self.saved.append, presses=presses)

    def charge(self, contact):
        """Return the charges of a press."""
        return self.charges.charges(self.values, contact[None])[0]

    def press(self, count):
        """Make the proposed presses."""
        for _ in range(count):
            contact = self.session.proposed.contact
            self.session.take(self.charge(contact), contact)


pytestmark = pytest.mark.usefixtures("never_solved", "few_hypotheses")


@pytest.fixture(autouse=True)
def _synthetic_films(monkeypatch, synthetic):
    """The film of the sensor file is the synthetic film."""
    monkeypatch.setattr(session_module, "solve_even", lambda *_: synthetic)


@pytest.fixture(scope="module")
def plan(problem, synthetic):
    """Eight planned presses, which determine most of the described film."""
    return next_presses(problem, synthetic, 8)


def test_session_reports_its_errors_and_continues_with_saved_presses(problem, synthetic, plan):
    rig = ExactRig(problem, synthetic, plan)
    rig.press(3)
    session = rig.session
    error = session.result.film_error
    assert f"errors of {error.position_mm:.2g} mm and {error.force_percent:.2g} %" in session.summary[0]
    assert [presses.lines for presses in rig.saved] == [(2,), (2, 3), (2, 3, 4)]
    assert not session.enough
    continued = PressSession(problem, save=rig.saved.append, presses=rig.saved[2], until=10.0)
    np.testing.assert_equal(continued.presses.columns, session.presses.columns)
    assert continued.summary == session.summary
    assert continued.proposed == session.proposed
    assert continued.enough


def test_press_that_cannot_be_saved_is_not_in_the_session(problem, plan):
    def raise_disk_full(_):
        raise OSError("no space")

    session = PressSession(problem, save=raise_disk_full)
    with pytest.raises(OSError, match="no space"):
        session.take(np.full(4, 500.0), plan[1].contact)
    assert len(session) == 0


def test_undo_removes_the_last_press(problem, synthetic, plan):
    rig = ExactRig(problem, synthetic, plan, 3)
    session = rig.session
    first_two = session.presses.charge_pC[:2]
    assert session.undo() == 3
    np.testing.assert_array_equal(rig.saved[-1].charge_pC, first_two)
    assert session.presses.lines == (2, 3)
    session.undo()
    session.undo()
    assert len(rig.saved[-1]) == 0
    assert session.summary == ()
    assert session.result is None
    with pytest.raises(PressError, match="no press to undo yet"):
        session.undo()


def test_press_whose_stated_place_is_wrong_is_named(problem, synthetic, plan):
    rig = ExactRig(problem, synthetic, plan, 5)
    charge = rig.charge(np.array([2.0, 3.0, 1.0]))
    rig.session.take(charge, np.array([5.0, 0.0, 1.0]))
    assert rig.session.result.bad_lines == (7,)
    assert rig.session.summary[1].startswith("Press 6, 1 N at (5.0, 0.0) mm, does not agree with the others")


@pytest.mark.parametrize(
    ("contact", "message"),
    [
        ((12.0, 0.0, 1.0), r"within 8\.5 mm of the centre .* got 1 N at \(12\.0, 0\.0\) mm"),
        ((1.0, 0.0, 100.0), r"of 0\.04 to 2\.5 N, got 100 N"),
        ((1.0, np.nan, 1.0), "both x and y"),
    ],
)
def test_press_outside_the_domain_is_refused_and_not_saved(problem, synthetic, plan, contact, message):
    rig = ExactRig(problem, synthetic, plan)
    with pytest.raises(PressError, match=message):
        rig.session.take(np.full(4, 500.0), np.array(contact))
    assert len(rig.session) == 0
    assert rig.saved == []


def test_presses_with_an_unknown_place_or_force_are_taken(problem, synthetic, plan):
    """The place is unknown with dead weights, and the force with a stage that has no load cell."""
    rig = ExactRig(problem, synthetic, plan, 2)
    x, y, force = plan[2].contact
    for contact in ([np.nan, np.nan, force], [x, y, np.nan]):
        rig.session.take(rig.charge(plan[2].contact), np.array(contact))
    assert not rig.session.result.estimation.is_bad.any()
    assert np.isnan(rig.saved[-1].contact).sum() == 3


NAN = float("nan")


@pytest.mark.parametrize(
    ("text", "reply", "contact"),
    [
        ("  \r", "take", None),
        ("3.1 -2.5 1.7", "take", (3.1, -2.5, 1.7)),
        ("? ? .5e0", "take", (NAN, NAN, 0.5)),
        (",,1", "take", (NAN, NAN, 1.0)),
        ("?", "take", (NAN, NAN, NAN)),
        ("U", "undo", None),
        ("q", "quit", None),
    ],
)
def test_typed_answer_is_read(text, reply, contact):
    answer = read_answer(text)
    assert answer.reply == reply
    np.testing.assert_array_equal(answer.contact, contact)


@pytest.mark.parametrize("text", ["3,1 2,5 1,7", "1 2", "1 2 3 4", "1 2 nan", "1 2 1e999", "u 3"])
def test_invalid_answer_is_refused(text):
    with pytest.raises(PressError, match="expected"):
        read_answer(text)
