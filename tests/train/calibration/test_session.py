"""A session of presses: proposals that follow the film, every change on disk first, undo, skip, bad presses."""

import numpy as np
import pytest
from tests.train.calibration.conftest import presses_of

from isocharge.common.errors import PressError
from isocharge.serve import MeasuredPresses
from isocharge.train import PressSession, next_presses
from isocharge.train.calibration.session import read_answer


class Bench:
    """A film that a seed draws, a rig that is as exact as it says, and a session about them."""

    def __init__(self, problem, plan, count=0, **options):
        """Go on with the first `count` presses of a plan."""
        self.problem = problem
        self.rng = np.random.default_rng(5)
        self.parameters = problem.prior.draw(self.rng, 1)[0]
        self.saved: list[MeasuredPresses] = []
        contact = np.array([press.contact for press in plan[:count]])
        presses = presses_of(problem, contact, np.array([self.charge(row) for row in contact])) if count else None
        self.session = PressSession(problem, save=self.saved.append, presses=presses, **options)

    def charge(self, contact):
        """Charges of a press that is read as this contact, but made beside it by the errors of the rig."""
        real = contact + self.rng.standard_normal(3) * [0.1, 0.1, 0.01 * contact[2]]
        return self.problem.noise.add(self.problem.charges.charges(self.parameters, real[None])[0], self.rng)

    def press(self, count=1):
        for _ in range(count):
            contact = self.session.proposed.contact
            self.session.take(self.charge(contact), contact)


@pytest.fixture(scope="module")
def plan(problem):
    """Eight presses that tell most of the film as described."""
    return next_presses(problem, 8)


def test_presses_make_a_film_known_as_well_as_their_plan_says(problem, plan):
    """The plan is linearised at the described film; the errors are those of the contacts on the film that was drawn."""
    bench = Bench(problem, plan)
    bench.press(3)
    result = bench.session.result
    session = bench.session
    assert result.error_left.position_mm < 2.0 * plan[2].position_mm
    unit = (result.posterior.parameters - bench.parameters) / problem.prior.std
    assert (
        unit @ np.linalg.solve(result.posterior.covariance, unit) < 40.0
    )  # 13 parameters: one film in 4000 is farther
    left = result.error_left
    assert f"errors of {left.position_mm:.2g} mm and {left.force_percent:.2g} %;" in session.summary[0]
    assert [presses.lines for presses in bench.saved] == [(1,), (1, 2), (1, 2, 3)]
    assert not session.enough
    again = PressSession(problem, save=bench.saved.append, presses=bench.saved[2], until=10.0)
    assert (again.presses, again.summary, again.proposed) == (session.presses, session.summary, session.proposed)
    assert again.enough


def test_every_change_is_saved_before_anything_is_computed(problem, plan):
    """A disk that is full is an error of the press that is lost, and of no other."""

    def full(_):
        raise OSError("no space")

    session = PressSession(problem, save=full)
    with pytest.raises(OSError, match="no space"):
        session.take(np.full(4, 500.0), plan[1].contact)
    assert len(session) == 0


def test_undo_takes_back_the_last_press_or_any(problem, plan):
    bench = Bench(problem, plan, 3)
    session = bench.session
    first, _, third = bench.session.presses.charge_pC
    assert session.undo(2) == 2
    np.testing.assert_array_equal(session.presses.charge_pC, [first, third])
    assert session.undo() == 2
    np.testing.assert_array_equal(bench.saved[-1].charge_pC, [first])
    assert session.presses.lines == (1,)
    with pytest.raises(PressError, match="there is no press 4 to undo: 1 is taken"):
        session.undo(4)
    session.undo()
    assert (len(bench.saved[-1]), session.summary, session.result) == (0, (), None)
    with pytest.raises(PressError, match="no press to undo yet"):
        session.undo()


def test_a_place_that_is_skipped_is_not_proposed_again(problem, plan):
    bench = Bench(problem, plan)
    skipped = []
    for _ in range(2):
        proposed = bench.session.proposed
        assert all(np.hypot(proposed.x_mm - x, proposed.y_mm - y) > 1.0 for x, y in skipped)
        skipped.append((proposed.x_mm, proposed.y_mm))
        bench.session.skip()
    bench.press()
    assert all(np.hypot(*(bench.session.presses.contact[:, :2] - at).T).min() > 1.0 for at in skipped)


def test_a_press_at_another_place_than_said_is_named(problem, plan):
    bench = Bench(problem, plan, 5)
    bench.session.take(bench.charge(np.array([2.0, 3.0, 1.0])), np.array([5.0, 0.0, 1.0]))
    assert bench.session.result.bad_lines == (6,)
    assert bench.session.summary[1].startswith("Press 6, 1.00 N at (5.0, 0.0) mm, does not agree with the others")


@pytest.mark.parametrize(
    ("contact", "message"),
    [
        ((12.0, 0.0, 1.0), r"within 9\.\d+ mm of the centre .* got 1\.00 N at \(12\.0, 0\.0\) mm"),
        ((1.0, 0.0, 100.0), r"of 0\.04 to 2\.4 N, got 100\.00 N"),
        ((1.0, np.nan, 1.0), "both x and y"),
    ],
)
def test_a_press_that_cannot_be_is_refused_and_nothing_is_taken(problem, plan, contact, message):
    bench = Bench(problem, plan)
    with pytest.raises(PressError, match=message):
        bench.session.take(np.full(4, 500.0), np.array(contact))
    assert (len(bench.session), bench.saved) == (0, [])


def test_presses_of_unknown_place_or_force_are_taken(problem, plan):
    """Dead weights, place unknown; and a stage without a load cell."""
    bench = Bench(problem, plan, 2)
    x, y, force = plan[2].contact
    for contact in ([np.nan, np.nan, force], [x, y, np.nan]):
        bench.session.take(bench.charge(plan[2].contact), np.array(contact))
    assert bench.session.result.posterior.bad.tolist() == [False] * 4
    assert np.isnan(bench.saved[-1].contact).sum() == 3


NAN = float("nan")


@pytest.mark.parametrize(
    ("text", "reply", "details"),
    [
        ("  \r", "take", {}),
        ("3.1 -2.5 1.7", "take", {"contact": (3.1, -2.5, 1.7)}),
        ("3.1, -2.5, 1.7", "take", {"contact": (3.1, -2.5, 1.7)}),
        ("? ? .5e0", "take", {"contact": (NAN, NAN, 0.5)}),
        (",,1", "take", {"contact": (NAN, NAN, 1.0)}),
        ("?", "take", {"contact": (NAN, NAN, NAN)}),
        ("u", "undo", {}),
        ("U 12", "undo", {"number": 12}),
        ("s", "skip", {}),
        ("quit", "quit", {}),
    ],
)
def test_answers(text, reply, details):
    answer = read_answer(text)
    expected = {"contact": "as proposed", "number": "last"} | details
    assert (answer.reply, answer.number) == (reply, expected["number"])
    np.testing.assert_array_equal(answer.contact, expected["contact"])


@pytest.mark.parametrize("text", ["3,1 2,5 1,7", "3 2,", "1 2", "1 2 3 4", "1 2 nan", "1 2 1e999", "yes", "u -1"])
def test_what_is_no_answer_is_said(text):
    with pytest.raises(PressError, match="expected"):
        read_answer(text)
