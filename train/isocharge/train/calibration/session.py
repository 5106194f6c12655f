"""Session of presses taken one after the other: the next press, the film so far, undo, and when to stop.

No port, no screen and no clock: whoever drives a session shows what it proposes, brings the charges of the press, and
passes on what a person answers.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.serve.prediction.measured_presses import FORCE_STD, POSITION_STD_MM, MeasuredPresses
from isocharge.train.calibration.calibrate import FEW, CalibrationResult, calibrate, no_presses
from isocharge.train.calibration.contact_error import ProposedPress, next_presses
from isocharge.train.calibration.diagnosis import outside
from isocharge.train.calibration.problem import CalibrationProblem

FEWEST_TO_SAY = 2
"""Presses from which the error left is said: one press alone says little."""

ENOUGH = 0.5
"""Error left by the film, as a share of the position error that noise alone leaves, at which a session is over."""

EXPECTED_ANSWER = (
    'Enter for "as proposed", the real "x y force" in mm and N (? for a value that is unknown), s to skip the place, '
    "u to undo the last press (u 3: press 3), or q to end"
)


Reply = Literal["take", "skip", "undo", "quit"]
"""What a person wants."""

WORDS: dict[str, Reply] = {"": "take", "take": "take", "s": "skip", "skip": "skip", "q": "quit", "quit": "quit"}
"""What stands for it."""


@dataclass(frozen=True)
class Answer:
    """What a person says of a press.

    Attributes:
        reply: What to do.
        contact: Where the press to take was: (x_mm, y_mm, force_N), NaN where unknown, shape (3,).
        number: The press to undo, from 1.
    """

    reply: Reply
    contact: Array | Literal["as proposed"] = "as proposed"
    number: int | Literal["last"] = "last"


def read_answer(text: str) -> Answer:
    """Return the meaning of a line that a person typed.

    Args:
        text: Empty, three values with blanks or commas between them, `u`, `u 3`, `s` or `q`.

    Raises:
        PressError: If it is something else.
    """
    word = text.strip().lower()
    if word in WORDS:
        return Answer(WORDS[word])
    if undo := re.fullmatch(r"(?:u|undo)\s*(\d*)", word):
        return Answer("undo", number=int(undo[1]) if undo[1] else "last")
    cells = [cell.strip() for cell in (word.split(",") if "," in word else word.split())] * (3 if word == "?" else 1)
    is_given = [cell not in ("", "?") for cell in cells]
    try:
        contact = np.array([float(cell) if given else np.nan for cell, given in zip(cells, is_given, strict=True)])
    except ValueError:
        contact = np.empty(0)
    if contact.shape != (3,) or not np.array_equal(np.isfinite(contact), is_given):
        raise PressError(f"expected {EXPECTED_ANSWER}; got {text.strip()!r:.60}")
    return Answer("take", contact)


class PressSession:
    """The presses of one film as they are taken, and what they say of it.

    Attributes:
        problem: The films that it may be, and the estimate before the presses.
        presses: Taken so far, numbered from 1 by their lines.
        result: The film by now; None without presses, or where no film explains them.
        refusal: Why no film explains the presses; empty where one does.
    """

    result: CalibrationResult | None
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
        """Begin a session, or go on with one.

        Args:
            problem: The films.
            save: Called with all presses whenever they change, before anything is computed.
            presses: Those of a session that was stopped.
            position_std_mm: How well the rig knows a place, mm.
            force_std: How well it knows a force, share.
            until: Error left by the film as a share of that of noise, at which it is enough; 0 for never.
        """
        self.problem, self._save, self._until = problem, save, until
        self._std = {"position_std_mm": position_std_mm, "force_std": force_std}
        self._skipped: list[tuple[float, float]] = []
        self._fit(presses or no_presses(problem.electrodes))

    def __len__(self) -> int:
        return len(self.presses)

    @property
    def proposed(self) -> ProposedPress:
        """The press that would tell most now.

        Raises:
            PressError: If every place was skipped.
        """
        if self._proposed is None:
            film, avoid = self.problem.expected, np.reshape(self._skipped, (-1, 2))
            count = len(self) + 1  # of a plan for presses that no film explains
            if self.result:
                film, count = self.result.posterior, 1
            self._proposed = next_presses(self.problem, count, film, avoid_mm=avoid, **self._std)[-1]
        return self._proposed

    @property
    def enough(self) -> bool:
        """Whether the error left by the film is below the share of the noise that was asked for."""
        if self.result is None or len(self) < FEW:
            return False
        return self.result.error_left.position_mm <= self._until * self.result.sensitivity.noise_error.position_mm

    def take(self, charge: Array, contact: Array) -> None:
        """Take a press, save all, and fit the film.

        Args:
            charge: Touch charges, shape (n_electrode,), pC.
            contact: (x, y, F), NaN where unknown, shape (3,), mm and N.

        Raises:
            PressError: If there can be no such press; nothing is taken.
        """
        self.check(contact)
        taken = self.presses
        self._change(
            replace(
                taken,
                contact=np.vstack([taken.contact, contact]),
                charge_pC=np.vstack([taken.charge_pC, charge]),
                position_std_mm=np.append(taken.position_std_mm, self._std["position_std_mm"]),
                force_std=np.append(taken.force_std, self._std["force_std"]),
                lines=(*taken.lines, len(taken) + 1),
            )
        )

    def check(self, contact: Array) -> None:
        """Raise PressError if no calibration takes a press (x, y, F), NaN where unknown, shape (3,), mm and N."""
        domain = self.problem.charges.domain
        if math.isnan(contact[0]) != math.isnan(contact[1]):
            raise PressError("expected both x and y, or ? for both, got one of them")
        if outside(contact[None], domain).any():
            low, high = domain.force_range
            raise PressError(
                f"expected a press within {domain.radius:.3g} mm of the centre and of {low:.2g} to {high:.2g} N, "
                f"got {describe_press(contact)}; press there, or give the real values in mm and N"
            )

    def undo(self, number: int | Literal["last"] = "last") -> int:
        """Take a press back; the number of the press that is gone.

        Raises:
            PressError: If there is no such press.
        """
        if not len(self):
            raise PressError("there is no press to undo yet")
        gone = len(self) if number == "last" else number
        if not 1 <= gone <= len(self):
            raise PressError(f"there is no press {gone} to undo: {len(self)} {'is' if len(self) == 1 else 'are'} taken")
        self._change(self.presses[np.arange(len(self)) != gone - 1])
        return gone

    def skip(self) -> None:
        """Propose another place than this one, from now on."""
        self._skipped.append((self.proposed.x_mm, self.proposed.y_mm))
        self._proposed = None

    def _change(self, presses: MeasuredPresses) -> None:
        self._save(presses)
        self._fit(presses)

    def _fit(self, presses: MeasuredPresses) -> None:
        self.presses = replace(presses, lines=tuple(range(1, len(presses) + 1)))
        self.result, self.refusal, self._proposed = None, "", None
        try:
            self.result = calibrate(self.presses, self.problem) if len(presses) else None
        except PressError as error:
            self.refusal = str(error)

    @property
    def summary(self) -> tuple[str, ...]:
        """The error that the film leaves so far, and the presses that fit badly, a sentence each."""
        if self.refusal:
            return (f"No film explains these presses: {self.refusal}",)
        if self.result is None or len(self) < FEWEST_TO_SAY:
            return ()
        left, noise = self.result.error_left, self.result.sensitivity.noise_error
        return (
            f"{left.position_mm:.2g} mm and {left.force_percent:.2g} % are left by not knowing the film; "
            f"noise alone is {noise.position_mm:.2g} mm and {noise.force_percent:.2g} %.",
            *(
                f"Press {number}, {describe_press(self.presses.contact[number - 1])}, fits no film that the others "
                f"fit, and is left out: was it there, and as hard? u {number} takes it back."
                for number in self.result.bad_lines
            ),
        )


def describe_press(contact: Array) -> str:
    """A press (x, y, F), shape (3,), mm and N, as "1.65 N at (3.0, 2.5) mm"; NaN is unknown."""
    x, y, force = contact.tolist()
    how = "an unknown force" if math.isnan(force) else f"{force:.2f} N"
    return f"{how} at an unknown place" if math.isnan(x) else f"{how} at ({x:.1f}, {y:.1f}) mm"
