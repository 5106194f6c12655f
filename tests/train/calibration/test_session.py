"""A session at the bench: proposals that follow the film, every change on disk first, undo, skip, bad presses."""

import numpy as np
import pytest

from isocharge.common.errors import PressError
from isocharge.serve import MeasuredPresses
from isocharge.train import BenchSession, calibrate, next_presses
from isocharge.train.calibration.session import Answer, Reply, read_answer


class Bench:
    """A film that a seed draws, a rig that is as exact as it says, and a session about them."""

    def __init__(self, layout, plan, count=0, **options):
        """Go on with the first `count` presses of a plan."""
        self.scene, self.charges = layout.scene, layout.scene.charges
        self.rng = np.random.default_rng(5)
        self.parameters = self.charges.prior.draw(self.rng, 1)[0]
        self.saved: list[MeasuredPresses] = []
        contact = np.array([press.contact for press in plan[:count]]).reshape(-1, 3)
        charge = np.array([self.charge(row) for row in contact]).reshape(-1, 4)
        self.session = BenchSession(
            layout.scene,
            layout.described,
            save=self.saved.append,
            presses=presses_of(contact, charge, ("A", "B", "C", "D")) if count else None,
            **options,
        )

    def charge(self, contact):
        """Charges of a press that is read as this contact, but made beside it by the errors of the rig."""
        real = contact + self.rng.standard_normal(3) * [0.1, 0.1, 0.01 * contact[2]]
        charge = self.charges.charge_pC(self.parameters, real[None])[0]
        return charge + np.hypot(1.0, 0.002 * charge) * self.rng.standard_normal(charge.size)

    def press(self, count=1):
        for _ in range(count):
            contact = self.session.proposed.contact
            self.session.take(self.charge(contact), contact)


def presses_of(contact, charge, names):
    """On the lines 2, 3, ... of a file."""
    count = len(contact)
    std = np.full(count, 0.1), np.full(count, 0.01)
    return MeasuredPresses(contact, charge, *std, names, tuple(range(2, count + 2)))


@pytest.fixture(scope="module")
def plan(four):
    """Eight presses that tell most of the film as described."""
    return next_presses(four.scene.charges, four.scene.domain, four.scene.noise, 8)


@pytest.fixture
def bench(four, plan):
    return Bench(four, plan)


def test_five_presses_make_a_film_known_as_well_as_their_plan_says(bench, plan):
    """The plan is linearised at the described film; the errors are those of the contacts on the film that was drawn."""
    bench.press(5)
    left, noise = bench.session.calibration.left, bench.session.calibration.sensitivity.of_noise()
    assert left.position_mm < 2.0 * plan[4].position_mm
    deviation = bench.session.calibration.posterior.parameters - bench.parameters
    unit = deviation / bench.charges.prior.std
    covariance = bench.session.calibration.posterior.covariance
    assert unit @ np.linalg.solve(covariance, unit) < 40.0  # 14 parameters: one film in 4000 is farther
    assert f"{left.position_mm:.2g} mm and {left.force_percent:.2g} % are left" in bench.session.words[0]
    assert f"noise alone is {noise.position_mm:.2g} mm" in bench.session.words[0]


def test_a_session_is_its_presses(bench):
    """What a session knows is what `calibrate` says of the presses in its file."""
    bench.press(3)
    alone = calibrate(bench.saved[-1], bench.scene, bench.session.before)
    np.testing.assert_array_equal(alone.posterior.parameters, bench.session.calibration.posterior.parameters)
    assert [len(presses) for presses in bench.saved] == [1, 2, 3]
    assert bench.saved[-1].lines == (1, 2, 3)


def test_every_change_is_saved_before_anything_is_computed(four, plan):
    """A disk that is full is an error of the press that is lost, and of no other."""
    bench = Bench(four, plan, 1)
    bench.session._save = lambda _: (_ for _ in ()).throw(OSError("no space"))
    with pytest.raises(OSError, match="no space"):
        bench.press()
    assert len(bench.session) == 1


def test_undo_takes_back_the_last_press_or_any(four, plan):
    bench = Bench(four, plan, 3)
    first, _, third = bench.session.presses.charge_pC
    assert bench.session.undo(2) == 2
    np.testing.assert_array_equal(bench.session.presses.charge_pC, [first, third])
    assert bench.session.undo() == 2
    np.testing.assert_array_equal(bench.saved[-1].charge_pC, [first])
    assert bench.session.presses.lines == (1,)
    bench.session.undo()
    assert (len(bench.saved[-1]), bench.session.words, bench.session.calibration) == (0, (), None)
    with pytest.raises(PressError, match="no press to undo yet"):
        bench.session.undo()
    bench.press()
    with pytest.raises(PressError, match="there is no press 4 to undo: 1 is taken"):
        bench.session.undo(4)


def test_a_place_that_is_skipped_is_not_proposed_again(bench):
    skipped = []
    for _ in range(4):
        proposed = bench.session.proposed
        assert all(np.hypot(proposed.x_mm - x, proposed.y_mm - y) > 1.0 for x, y in skipped)
        skipped.append((proposed.x_mm, proposed.y_mm))
        bench.session.skip()
    bench.press()
    assert all(np.hypot(*(bench.session.presses.contact[:, :2] - at).T).min() > 1.0 for at in skipped)


def test_a_stopped_session_goes_on_where_it_was(four, plan):
    bench = Bench(four, plan, 1)
    bench.press()
    again = BenchSession(four.scene, four.described, save=bench.saved.append, presses=bench.saved[-1])
    assert again.presses == bench.session.presses
    assert again.proposed == bench.session.proposed
    assert again.words == bench.session.words


def test_it_is_enough_at_the_share_that_was_asked_for(four, plan):
    for until, enough in ((1.0, True), (0.05, False), (0.0, False)):
        bench = Bench(four, plan, 5, until=until)
        left, noise = bench.session.calibration.left, bench.session.calibration.sensitivity.of_noise()
        assert (left.position_mm <= until * noise.position_mm) == bench.session.enough == enough


def test_a_press_at_another_place_than_said_is_named(four, plan):
    bench = Bench(four, plan, 7)
    wrong = np.array([5.0, 0.0, 1.0])
    bench.session.take(bench.charge(np.array([2.0, 3.0, 1.0])), wrong)
    assert bench.session.calibration.bad_lines == (8,)
    assert bench.session.words[1].startswith("Press 8, 1.00 N at (5.0, 0.0) mm, fits no film that the others fit")
    bench.session.undo()
    assert len(bench.session.words) == 1


@pytest.mark.slow
def test_presses_that_no_film_explains_end_no_session(four, plan, bench):
    """Columns swapped: said, the presses stay, others are proposed, and undo helps."""
    contact = np.array([press.contact for press in plan[:7]])
    swapped = np.array([bench.charge(row) for row in contact])[:, [2, 1, 0, 3]]
    presses = presses_of(contact, swapped, ("A", "B", "C", "D"))
    session = BenchSession(four.scene, four.described, save=bench.saved.append, presses=presses)
    assert session.calibration is None
    assert "swapped" in session.problem
    assert session.words[0].startswith("No film explains these presses")
    assert not session.enough
    np.testing.assert_allclose(session.proposed.contact, plan[7].contact)  # as if the presses had been good
    assert session.undo() == 7
    assert len(bench.saved[-1]) == 6


@pytest.mark.parametrize(
    ("contact", "message"),
    [
        ((12.0, 0.0, 1.0), r"within 9\.\d+ mm of the centre .* got 1\.00 N at \(12\.0, 0\.0\) mm"),
        ((1.0, 0.0, 100.0), r"of 0\.04 to 2\.4 N, got 100\.00 N"),
        ((1.0, np.nan, 1.0), "both x and y"),
    ],
)
def test_a_press_that_cannot_be_is_refused_and_nothing_is_taken(bench, contact, message):
    with pytest.raises(PressError, match=message):
        bench.session.take(np.full(4, 500.0), np.array(contact))
    assert (len(bench.session), bench.saved) == (0, [])


def test_presses_of_unknown_place_or_force_are_taken(four, plan):
    """Dead weights, place unknown; and a stage without a load cell."""
    bench = Bench(four, plan, 2)
    contact = plan[2].contact
    bench.session.take(bench.charge(contact), np.array([np.nan, np.nan, contact[2]]))
    bench.session.take(bench.charge(contact), np.array([contact[0], contact[1], np.nan]))
    assert bench.session.calibration.posterior.bad.tolist() == [False] * 4
    assert np.isnan(bench.saved[-1].contact).sum() == 3


NAN = float("nan")


@pytest.mark.parametrize(
    ("text", "answer"),
    [
        ("", (Reply.take, None, None)),
        ("  \r", (Reply.take, None, None)),
        ("3.1 -2.5 1.7", (Reply.take, (3.1, -2.5, 1.7), None)),
        ("3.1, -2.5, 1.7", (Reply.take, (3.1, -2.5, 1.7), None)),
        ("? ? .5e0", (Reply.take, (NAN, NAN, 0.5), None)),
        (",,1", (Reply.take, (NAN, NAN, 1.0), None)),
        ("3 2,", None),
        ("?", (Reply.take, (NAN, NAN, NAN), None)),
        ("u", (Reply.undo, None, None)),
        ("U 12", (Reply.undo, None, 12)),
        ("undo", (Reply.undo, None, None)),
        ("s", (Reply.skip, None, None)),
        ("quit", (Reply.quit, None, None)),
        ("3,1 2,5 1,7", None),
        ("1 2", None),
        ("1 2 3 4", None),
        ("1 2 nan", None),
        ("1 2 1e999", None),
        ("1_0 2 3", None),
        ("yes", None),
        ("u -1", None),
    ],
)
def test_answers(text, answer):
    if answer is None:
        with pytest.raises(PressError, match="expected"):
            read_answer(text)
        return
    got: Answer = read_answer(text)
    assert (got.reply, got.number) == (answer[0], answer[2])
    if answer[1] is None:
        assert got.contact is None
    else:
        np.testing.assert_array_equal(got.contact, answer[1])
