"""Session in which a person or a machine makes presses one after the other. The session proposes the contacts.

After each press, the film is fitted again, and the next press is proposed. A session does not access a serial port, a
screen or a clock. The caller shows the proposed press, measures the charges, and passes the answer of the person to the
session.
"""

import math
import re
from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.serve.presses.measured_presses import CONTACT, FORCE_STD, POSITION_STD_MM, MeasuredPresses
from isocharge.train.calibration.calibrate import calibrate, solve_even
from isocharge.train.calibration.contact_error import ProposedPress, next_presses
from isocharge.train.calibration.estimator import FEW_PRESSES
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.problem import CalibrationProblem, domain_words
from isocharge.train.calibration.result import CalibrationResult

SUFFICIENT_ERROR_RATIO = 0.5
"""A session is complete when the ratio of two position errors is at most this number.

The ratio is the error due to the uncertainty of the film, divided by the error due to noise."""

EXPECTED_ANSWER = (
    'Enter for "as proposed", the real "x y force" in mm and N (? for a value that is unknown), u to undo the last '
    "press, or q to quit"
)

Reply = Literal["take", "undo", "quit"]
"""Action that a person requests."""

REPLIES: dict[str, Reply] = {"": "take", "u": "undo", "q": "quit"}
"""Action for each text that a person can type to request it."""


_CELL = re.compile(r"\??|[-+]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[-+]?[0-9]{1,2})?")
"""Pattern of the text for one value of a contact: a number, a question mark or nothing."""


class Answer(NamedTuple):
    """Answer of a person to a proposed press.

    Attributes:
        reply: The requested action.
        contact: Contact (x_mm, y_mm, force_N) of the press that is added, shape (3,), NaN where unknown; None if the
            press was made at the proposed contact.
    """

    reply: Reply
    contact: Array | None = None


def read_answer(text: str) -> Answer:
    """Convert the text that a person typed into an answer.

    Args:
        text: An empty text, a question mark, three values with blanks or commas between them, `u` or `q`.

    Raises:
        PressError: If the text has none of these forms.
    """
    normalised_text = text.strip().lower()
    if normalised_text in REPLIES:
        return Answer(REPLIES[normalised_text])
    # A question mark alone stands for an unknown place and an unknown force.
    value_text = "? ? ?" if normalised_text == "?" else normalised_text
    separator = "," if "," in value_text else None  # None: any blanks
    cells = [cell.strip() for cell in value_text.split(separator)]
    if len(cells) != len(CONTACT) or not all(map(_CELL.fullmatch, cells)):
        # The message repeats at most 60 characters of the text in quotes (!r:.60).
        raise PressError(f"expected {EXPECTED_ANSWER}; got {text.strip()!r:.60}")
    # A cell is unknown if it is empty or a question mark: nothing remains without question marks.
    values = [float(cell) if cell.strip("?") else np.nan for cell in cells]
    return Answer("take", np.array(values))


class PressSession:
    """Session of presses on one film, with the presses so far and the present estimate of the film.

    Attributes:
        problem: The calibration problem, which defines the possible films and their estimate before the presses.
        presses: All presses so far, in the order in which they were made. Their line numbers begin at 2, below the
            header of a file.
        result: Result of the calibration by these presses; None without presses, or if no film explains the presses.
        refusal: Reason why no film explains the presses; empty if a film explains the presses or if there are none.
    """

    presses: MeasuredPresses
    result: CalibrationResult | None
    refusal: str
    _proposed: ProposedPress | None

    def __init__(
        self,
        problem: CalibrationProblem,
        *,
        save: Callable[[MeasuredPresses], None],
        presses: MeasuredPresses | None = None,
        position_std_mm: float = POSITION_STD_MM,
        force_std: float = FORCE_STD,
        until: float = SUFFICIENT_ERROR_RATIO,
        executor: Executor | None = None,
    ) -> None:
        """Begin a session, or continue an earlier session.

        Args:
            problem: The calibration problem.
            save: Function that stores the presses. After each change of the presses, it is called with all presses,
                before the film is fitted.
            presses: Presses of an earlier session that is continued; None to begin without presses.
            position_std_mm: Standard deviation of the positions of further presses, mm.
            force_std: Standard deviation of the forces of further presses, relative to the force.
            until: Ratio of two position errors at which the session is complete, as explained at
                `SUFFICIENT_ERROR_RATIO`. With 0, the session is never complete.
            executor: Executor that runs the solves; None for this process.
        """
        self.problem = problem
        self._executor = executor
        self._save = save
        self._sufficient_ratio = until
        self._stds = {"position_std_mm": position_std_mm, "force_std": force_std}
        presses = presses or MeasuredPresses(
            contact=np.empty((0, 3)),
            charge_pC=np.empty((0, len(problem.electrodes))),
            position_std_mm=np.empty(0),
            force_std=np.empty(0),
            electrodes=problem.electrodes,
            lines=(),  # numbered below
        )
        # The saved file has the presses on the lines after its header, which is line 1.
        self._fit(replace(presses, lines=tuple(range(2, len(presses) + 2))))

    def __len__(self) -> int:
        return len(self.presses)

    @cached_property
    def _charges(self) -> FilmCharges:
        """Charges of the film that was solved last, with which the next fit begins. The first solved film is even."""
        return solve_even(self.problem, self._executor)

    @property
    def proposed(self) -> ProposedPress:
        """The proposed next press, with the largest expected reduction of the remaining error.

        The proposal is computed at the first access after each change, and is then stored.
        """
        if self._proposed is None:
            # If there are no presses, or no film explains them, all presses are planned from the beginning. The presses
            # so far count as the first presses of this plan, and the press after them is proposed.
            film = None if self.result is None else self.result.film
            planned_count = 1 if film is not None else len(self) + 1
            # `_stds` contains the standard deviations of the positions and forces of further presses.
            plan = next_presses(self.problem, self._charges, planned_count, film, **self._stds)
            self._proposed = plan[-1]
        return self._proposed

    @property
    def enough(self) -> bool:
        """Whether the position errors due to the uncertainty of the film are small compared with those due to noise."""
        if self.result is None or len(self) < FEW_PRESSES:
            return False
        noise_mm = self.result.sensitivity.noise_error.position_mm
        return self.result.film_error.position_mm <= self._sufficient_ratio * noise_mm

    def take(self, charge: Array, contact: Array) -> None:
        """Add a press, save all presses, and fit the film to them.

        Args:
            charge: Touch charges of the press, shape (n_electrode,), pC.
            contact: Contact (x, y, F) of the press, shape (3,), mm and N, NaN where unknown.

        Raises:
            PressError: If a calibration does not accept a press with this contact. The session is then unchanged.
        """
        self.check(contact)
        presses = self.presses
        extended_presses = replace(
            presses,
            contact=np.vstack([presses.contact, contact]),
            charge_pC=np.vstack([presses.charge_pC, charge]),
            position_std_mm=np.append(presses.position_std_mm, self._stds["position_std_mm"]),
            force_std=np.append(presses.force_std, self._stds["force_std"]),
            lines=(*presses.lines, len(presses) + 2),
        )
        self._save_and_fit(extended_presses)

    def check(self, contact: Array) -> None:
        """Raise PressError if a calibration does not accept presses with a given contact.

        A contact is refused if only one of x and y is known, or if a known position or force is outside the solved
        domain.

        Args:
            contact: Contact (x, y, F) of the press, shape (3,), mm and N, NaN where unknown.
        """
        x, y, _ = contact.tolist()
        if math.isnan(x) != math.isnan(y):
            raise PressError("expected both x and y, or ? for both, got one of them")
        domain = self.problem.solved_domain
        if domain.is_outside(contact[None]).any():
            raise PressError(
                f"expected a press {domain_words(domain)}, got {describe_press(contact)}; press there, or give the "
                "real values in mm and N"
            )

    def undo(self) -> int:
        """Remove the last press, fit the film to the other presses, and return the number of the removed press.

        Raises:
            PressError: If there is no press.
        """
        count = len(self)  # also the number of the last press
        if not count:
            raise PressError("there is no press to undo yet")
        self._save_and_fit(self.presses[:-1])
        return count

    def _save_and_fit(self, presses: MeasuredPresses) -> None:
        """Save a changed list of presses, and fit the film to the presses in the list."""
        self._save(presses)
        self._fit(presses)

    def _fit(self, presses: MeasuredPresses) -> None:
        """Fit the film to presses.

        If no film explains the presses, `result` becomes None, and `refusal` becomes the reason. Without presses,
        `result` becomes None, and `refusal` becomes empty.

        Args:
            presses: All presses of the session.
        """
        self.presses = presses
        self.result = None
        self.refusal = ""
        self._proposed = None
        if not len(presses):
            return
        try:
            # The next press must be proposed at once. With accurate=False, an uneven film is not solved, and its
            # unevenness is only a first-order change of the charges.
            self.result = calibrate(presses, self.problem, executor=self._executor, start=self._charges, accurate=False)
        except PressError as error:
            self.refusal = str(error)
        else:
            self._charges = self.result.charges

    @property
    def summary(self) -> tuple[str, ...]:
        """Sentences about contact errors due to the film, and about presses that do not agree with the others.

        If no film explains the presses, there is only one sentence, which states the reason. Without presses, there are
        no sentences.
        """
        if self.refusal:
            return (f"No film explains these presses: {self.refusal}",)
        if self.result is None:
            return ()
        error_sentence = self.result.summary[0]
        # The first press is on line 2 of the file, below the header. It has the number 1 and the index 0.
        bad_sentences = [
            f"Press {line - 1}, {describe_press(self.presses.contact[line - 2])}, does not agree with the others and "
            "is left out. Were its position and its force as stated?"
            for line in self.result.bad_lines
        ]
        return (error_sentence, *bad_sentences)


def describe_press(contact: Array) -> str:
    """Describe the contact of a press in words, such as "1.65 N at (3.0, 2.5) mm".

    Args:
        contact: Contact (x, y, F), shape (3,), mm and N, NaN where unknown.
    """
    x, y, force = contact.tolist()
    force_text = "an unknown force" if math.isnan(force) else f"{force:.3g} N"
    place_text = "an unknown place" if math.isnan(x) else f"({x:.1f}, {y:.1f}) mm"
    return f"{force_text} at {place_text}"
