"""Session in which a person or a machine makes presses one after the other, at proposed contacts.

After each press, the film is fitted again, and the next press is proposed. A session has no port, no screen and no
clock. The caller shows the proposed press, measures the charges, and passes on the answer of the person.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.common.measured_presses import CONTACT, FORCE_STD, POSITION_STD_MM, MeasuredPresses
from isocharge.train.calibration.calibrate import FEW, calibrate
from isocharge.train.calibration.contact_error import ProposedPress, next_presses
from isocharge.train.calibration.press_data import no_presses
from isocharge.train.calibration.problem import CalibrationProblem, FilmEstimate
from isocharge.train.calibration.result import CalibrationResult

MIN_PRESSES = 2
"""Smallest number of presses after which the remaining error is reported. One press does not determine it."""

ENOUGH = 0.5
"""Ratio of two position errors at which a session is complete.

The first error is caused by the uncertainty of the film, and the second error by noise."""

EXPECTED_ANSWER = (
    'Enter for "as proposed", the real "x y force" in mm and N (? for a value that is unknown), s to skip the place, '
    "u to undo the last press (u 3: press 3), or q to quit"
)

Reply = Literal["take", "skip", "undo", "quit"]
"""Action that a person asks for."""

REPLIES: dict[str, Reply] = {"": "take", "take": "take", "s": "skip", "skip": "skip", "q": "quit", "quit": "quit"}
"""Actions by the word that is typed for them."""

UNDO = re.compile(r"(?:u|undo)\s*(\d*)")
"""Word that undoes a press, with the number of the press or without."""

UNKNOWN_CELLS = ("", "?")
"""Words for a value that is unknown."""


@dataclass(frozen=True)
class Answer:
    """Answer of a person about a press.

    Attributes:
        reply: Action to take.
        contact: Contact (x_mm, y_mm, force_N) of the press to take, shape (3,), NaN where unknown.
        number: Number of the press to undo, from 1.
    """

    reply: Reply
    contact: Array | Literal["as proposed"] = "as proposed"
    number: int | Literal["last"] = "last"


def read_answer(text: str) -> Answer:
    """Return the answer that a person typed.

    Args:
        text: Empty, three values with blanks or commas between them, `u`, `u 3`, `s` or `q`.

    Raises:
        PressError: If the text is something else.
    """
    word = text.strip().lower()
    if word in REPLIES:
        return Answer(REPLIES[word])
    undo_match = UNDO.fullmatch(word)
    if undo_match is not None:
        digits = undo_match[1]
        return Answer("undo", number=int(digits) if digits else "last")
    if word == "?":  # a press with an unknown place and an unknown force
        return Answer("take", np.full(len(CONTACT), np.nan))

    cells = word.split(",") if "," in word else word.split()
    refusal = PressError(f"expected {EXPECTED_ANSWER}; got {text.strip()!r:.60}")  # at most 60 characters of the text
    if len(cells) != len(CONTACT):
        raise refusal
    try:
        contact = np.array([_cell_value(cell.strip()) for cell in cells])
    except ValueError:
        raise refusal from None
    return Answer("take", contact)


def _with_unknown(temperatures_C: Array | None) -> Array | None:
    """Append an unknown temperature to the temperatures of earlier presses.

    Args:
        temperatures_C: Temperatures, shape (n,), degrees Celsius; None if no temperatures are measured.

    Returns:
        Temperatures, shape (n + 1,). The last one is NaN. None if no temperatures are measured.
    """
    if temperatures_C is None:
        return None
    return np.append(temperatures_C, np.nan)


def _cell_value(cell: str) -> float:
    """Return the number in a cell; NaN if the value is unknown.

    Args:
        cell: Text of the cell without blanks.

    Raises:
        ValueError: If the cell is not a finite number.
    """
    if cell in UNKNOWN_CELLS:
        return math.nan
    value = float(cell)
    if not math.isfinite(value):
        raise ValueError(f"expected a finite number, got {cell}")
    return value


class PressSession:
    """Presses of one film in the order in which they are made, and the present estimate of this film.

    Attributes:
        problem: Films that the sensor may be, and the estimate before the presses.
        presses: Presses so far; their lines are numbered from 1.
        result: Calibration by these presses; None without presses, or if no film explains them.
        refusal: Reason why no film explains the presses; empty if a film explains them.
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
        until: float = ENOUGH,
    ) -> None:
        """Begin a session, or continue an earlier one.

        Args:
            problem: Films that the sensor may be.
            save: Function that stores the presses. It is called with all presses after each change, before the film is
                fitted.
            presses: Presses of an earlier session to continue.
            position_std_mm: Standard deviation of the places of further presses, mm.
            force_std: Standard deviation of the forces of further presses, as a share of the force.
            until: Ratio of position errors at which the session is complete, as `ENOUGH`; 0 for never.
        """
        self.problem = problem
        self._save = save
        self._until = until
        self._stds = {"position_std_mm": position_std_mm, "force_std": force_std}
        self._skipped_places: list[tuple[float, float]] = []
        self._fit(presses or no_presses(problem.electrodes))

    def __len__(self) -> int:
        return len(self.presses)

    @property
    def proposed(self) -> ProposedPress:
        """The press that would reduce the remaining error most.

        Raises:
            PressError: If every place was skipped.
        """
        if self._proposed is not None:
            return self._proposed

        skipped_mm = np.reshape(self._skipped_places, (-1, 2))  # shape (0, 2) if no place was skipped
        film: FilmEstimate
        if self.result is not None:
            film = self.result.posterior
            count = 1
        else:
            # There are no presses, or no film explains them. The presses for the film of the sensor file are planned
            # from the beginning, and each press so far counts as one of the plan.
            film = self.problem.expected
            count = len(self) + 1
        plan = next_presses(self.problem, count, film, avoid_mm=skipped_mm, **self._stds)
        self._proposed = plan[-1]
        return self._proposed

    @property
    def enough(self) -> bool:
        """Whether the uncertainty of the film causes a small position error, compared with the error by noise."""
        if self.result is None or len(self) < FEW:
            return False
        noise_mm = self.result.sensitivity.noise_error.position_mm
        return self.result.error_left.position_mm <= self._until * noise_mm

    def take(self, charge: Array, contact: Array) -> None:
        """Add a press, save all presses, and fit the film.

        Args:
            charge: Touch charges, shape (n_electrode,), pC.
            contact: Contact (x, y, F), shape (3,), mm and N, NaN where unknown.

        Raises:
            PressError: If the press is not one that a calibration accepts. The session is then unchanged.
        """
        self.check(contact)
        presses = self.presses
        presses_with_new_one = replace(
            presses,
            contact=np.vstack([presses.contact, contact]),
            charge_pC=np.vstack([presses.charge_pC, charge]),
            position_std_mm=np.append(presses.position_std_mm, self._stds["position_std_mm"]),
            force_std=np.append(presses.force_std, self._stds["force_std"]),
            temperature_C=_with_unknown(presses.temperature_C),
            film_temperature_C=_with_unknown(presses.film_temperature_C),
            lines=(*presses.lines, len(presses) + 1),
        )
        self._change(presses_with_new_one)

    def check(self, contact: Array) -> None:
        """Raise PressError if no calibration accepts a press.

        Args:
            contact: Contact (x, y, F), shape (3,), mm and N, NaN where unknown.
        """
        x, y, _ = contact.tolist()
        has_one_coordinate = math.isnan(x) != math.isnan(y)
        if has_one_coordinate:
            raise PressError("expected both x and y, or ? for both, got one of them")
        domain = self.problem.charges.domain
        if domain.is_outside(contact[None]).any():
            min_force, max_force = domain.force_range
            raise PressError(
                f"expected a press within {domain.radius:.3g} mm of the centre and of {min_force:.2g} to "
                f"{max_force:.2g} N, got {describe_press(contact)}; press there, or give the real values in mm and N"
            )

    def undo(self, number: int | Literal["last"] = "last") -> int:
        """Remove a press, fit the film again, and return the number of the press.

        Args:
            number: Number of the press, counted from 1; "last" for the last press.

        Raises:
            PressError: If there is no such press.
        """
        count = len(self)
        if not count:
            raise PressError("there is no press to undo yet")
        removed_number = count if number == "last" else number
        if not 1 <= removed_number <= count:
            taken = "1 is taken" if count == 1 else f"{count} are taken"
            raise PressError(f"there is no press {removed_number} to undo: {taken}")
        numbers = np.arange(1, count + 1)
        self._change(self.presses[numbers != removed_number])
        return removed_number

    def skip(self) -> None:
        """Reject the proposed position, and propose another one. A rejected position is never proposed again."""
        self._skipped_places.append((self.proposed.x_mm, self.proposed.y_mm))
        self._proposed = None

    def _change(self, presses: MeasuredPresses) -> None:
        """Save a new list of presses, and fit the film."""
        self._save(presses)
        self._fit(presses)

    def _fit(self, presses: MeasuredPresses) -> None:
        """Number the presses from 1, and fit the film to them.

        If no film explains the presses, `result` is None and `refusal` is the reason. Without presses, `result` is None
        and `refusal` is empty.

        Args:
            presses: All presses of the session.
        """
        self.presses = replace(presses, lines=tuple(range(1, len(presses) + 1)), row_noun="press")
        self.result = None
        self.refusal = ""
        self._proposed = None
        if not len(presses):
            return
        try:
            self.result = calibrate(self.presses, self.problem)
        except PressError as error:
            self.refusal = str(error)

    @property
    def summary(self) -> tuple[str, ...]:
        """Sentences about the errors that the film causes, and about presses that disagree with the others."""
        if self.refusal:
            return (f"No film explains these presses: {self.refusal}",)
        if self.result is None or len(self) < MIN_PRESSES:
            return ()
        film_error = self.result.error_left
        noise_error = self.result.sensitivity.noise_error
        error_sentence = (
            f"The uncertainty of the film causes errors of {film_error.position_mm:.2g} mm and "
            f"{film_error.force_percent:.2g} %; noise alone causes {noise_error.position_mm:.2g} mm and "
            f"{noise_error.force_percent:.2g} %."
        )
        bad_sentences = [
            f"Press {number}, {describe_press(self.presses.contact[number - 1])}, does not agree with the others "
            f"and is left out. Were its position and its force as stated? Type u {number} to remove it."
            for number in self.result.bad_lines
        ]
        return (error_sentence, *bad_sentences)


def describe_press(contact: Array) -> str:
    """Describe a contact (x, y, F), shape (3,), mm and N, as in "1.65 N at (3.0, 2.5) mm". Unknown values are NaN."""
    x, y, force = contact.tolist()
    force_text = "an unknown force" if math.isnan(force) else f"{force:.2f} N"
    place_text = "an unknown place" if math.isnan(x) else f"({x:.1f}, {y:.1f}) mm"
    return f"{force_text} at {place_text}"
