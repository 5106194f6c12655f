"""A calibration at the bench: which press comes next, what is known by now, undo, and when it is enough.

No port, no screen and no clock: whoever drives a session shows what it proposes, brings the charges of the press, and
passes on what a person answers.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import PressError
from isocharge.common.number_text import number_of
from isocharge.serve.prediction.measured_presses import FORCE_STD, POSITION_STD_MM, MeasuredPresses
from isocharge.train.calibration.calibrate import (
    FEW,
    Calibration,
    CalibrationScene,
    EarlierFilm,
    calibrate,
)
from isocharge.train.calibration.next_press import ProposedPress, information_of, next_presses

FEWEST_TO_SAY = 2
"""Presses from which the error left is said: one press alone says little."""

ENOUGH = 0.5
"""Error left by the film, as a share of the position error that noise alone leaves, at which a session is over."""

Save = Callable[[MeasuredPresses], None]
"""Puts the presses of a session on disk."""

_UNDO = re.compile(r"(?:u|undo)\s*(\d*)", re.IGNORECASE)

EXPECTED_ANSWER = (
    'Enter for "as proposed", the real "x y force" in mm and N (? for a value that is unknown), s to skip the place, '
    "u to undo the last press (u 3: press 3), or q to end"
)


class Reply(StrEnum):
    """What a person wants."""

    take = "take"
    skip = "skip"
    undo = "undo"
    quit = "quit"


@dataclass(frozen=True)
class Answer:
    """What a person says of a press.

    Attributes:
        reply: What to do.
        contact: Where the press was, (x_mm, y_mm, force_N), NaN where unknown, shape (3,); None as proposed.
        number: The press to undo, from 1; None for the last.
    """

    reply: Reply
    contact: Array | None = None
    number: int | None = None


def read_answer(text: str) -> Answer:
    """What a line that a person typed means.

    Args:
        text: Empty, three values with blanks or commas between them, `u`, `u 3`, `s` or `q`.

    Raises:
        PressError: If it is something else; says what is expected.
    """
    text = text.strip()
    word = text.lower()
    if not word:
        return Answer(Reply.take)
    for reply in (Reply.skip, Reply.quit):
        if word in (reply[0], reply):
            return Answer(reply)
    if undo := _UNDO.fullmatch(word):
        return Answer(Reply.undo, number=int(undo[1]) if undo[1] else None)
    if word == "?":
        return Answer(Reply.take, np.full(3, np.nan))
    cells = text.split(",") if "," in text else text.split()
    if len(cells) != 3:
        raise PressError(f"expected {EXPECTED_ANSWER}; got {text!r:.60}")
    return Answer(Reply.take, np.array([_value(cell.strip(), text) for cell in cells]))


def _value(cell: str, text: str) -> float:
    if cell in ("", "?"):
        return np.nan
    try:
        value = number_of(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise PressError(f"expected a number with a decimal point, or ?, got {cell!r:.30} in {text!r:.60}")
    return value


class BenchSession:
    """The presses of one film as they are taken, and what they say of it.

    Attributes:
        scene: The films that it may be.
        before: What was known before the presses.
        presses: Taken so far, numbered from 1 by their lines.
        calibration: The film by now; None without presses, or where none explains them.
        problem: Why no film explains the presses; empty where one does.
    """

    def __init__(
        self,
        scene: CalibrationScene,
        before: EarlierFilm,
        *,
        save: Save,
        presses: MeasuredPresses | None = None,
        position_std_mm: float = POSITION_STD_MM,
        force_std: float = FORCE_STD,
        until: float = ENOUGH,
    ) -> None:
        """Begin a session, or go on with one.

        Args:
            scene: The films.
            before: What is known of this film: what its sensor file says, or an earlier calibration.
            save: Called with all presses whenever they change, before anything is computed.
            presses: Those of a session that was stopped.
            position_std_mm: How well the rig knows a place, mm.
            force_std: How well it knows a force, share.
            until: Error left by the film as a share of that of noise, at which it is enough; 0 for never.
        """
        self.scene, self.before = scene, before
        self.presses = _numbered(presses) if presses else _no_presses(scene.charges.prior.sensor.electrode_names)
        self.calibration: Calibration | None = None
        self.problem = ""
        self._save = save
        self._std = position_std_mm, force_std
        self._until = until
        self._skipped: list[tuple[float, float]] = []
        self._proposed: ProposedPress | None = None
        self._fit()

    def __len__(self) -> int:
        return len(self.presses)

    @property
    def proposed(self) -> ProposedPress:
        """The press that would tell most now.

        Raises:
            PressError: If every place was skipped.
        """
        if self._proposed is None:
            known = self.calibration.posterior if self.calibration else self._planned()
            scene, (position_std_mm, force_std) = self.scene, self._std
            (self._proposed,) = next_presses(
                scene.charges,
                scene.domain,
                scene.noise,
                1,
                known.parameters,
                known.covariance,
                position_std_mm=position_std_mm,
                force_std=force_std,
                avoid_mm=np.array(self._skipped).reshape(-1, 2),
            )
        return self._proposed

    def _planned(self) -> EarlierFilm:
        """What would be known if the presses said what presses at their places say: those that no film explains."""
        placed = self.presses.contact[np.isfinite(self.presses.contact).all(axis=1)]
        if not len(placed):
            return self.before
        scene, parameters = self.scene, self.before.parameters
        said = information_of(scene.charges, parameters, placed, scene.noise, *self._std).sum(axis=0)
        return EarlierFilm(parameters, np.linalg.inv(np.linalg.inv(self.before.covariance) + said))

    @property
    def enough(self) -> bool:
        """Whether the error left by the film is below the share of the noise that was asked for."""
        if self.calibration is None or len(self) < FEW:
            return False
        return self.calibration.left.position_mm <= self._until * self.calibration.sensitivity.of_noise().position_mm

    def take(self, charge_pC: Array, contact: Array) -> None:
        """Take a press, save all, and fit the film.

        Args:
            charge_pC: Touch charges, shape (n_electrode,), pC.
            contact: (x_mm, y_mm, force_N), NaN where unknown, shape (3,).

        Raises:
            PressError: If there can be no such press; nothing is taken.
        """
        self.check(contact)
        contacts, charges = np.vstack([self.presses.contact, contact]), np.vstack([self.presses.charge_pC, charge_pC])
        taken = self.presses
        position_std_mm, force_std = self._std
        self._change(
            MeasuredPresses(
                contacts,
                charges,
                np.append(taken.position_std_mm, position_std_mm),
                np.append(taken.force_std, force_std),
                taken.electrodes,
                (*taken.lines, len(taken) + 1),
            )
        )

    def check(self, contact: Array) -> None:
        """Raise PressError if no calibration takes a press (x_mm, y_mm, force_N), NaN where unknown, shape (3,)."""
        charges, (low, high) = self.scene.charges, self.scene.charges.force_range_N
        x_mm, y_mm, force_N = contact.tolist()
        if math.isnan(x_mm) != math.isnan(y_mm):
            raise PressError("expected both x and y, or ? for both, got one of them")
        if math.hypot(x_mm, y_mm) > charges.radius_mm or not (math.isnan(force_N) or low <= force_N <= high):
            raise PressError(
                f"expected a press within {charges.radius_mm:.3g} mm of the centre and of {low:.2g} to {high:.2g} N, "
                f"got {press_words(contact)}; press there, or give the real values in mm and N"
            )

    def undo(self, number: int | None = None) -> int:
        """Take a press back, the last one if no number is given; the number of the press that is gone.

        Raises:
            PressError: If there is no such press.
        """
        number = len(self) if number is None else number
        if not 1 <= number <= len(self):
            raise PressError(
                f"there is no press {number} to undo: {len(self)} {'is' if len(self) == 1 else 'are'} taken"
                if len(self)
                else "there is no press to undo yet"
            )
        self._change(_numbered(self.presses[np.arange(len(self)) != number - 1]))
        return number

    def skip(self) -> None:
        """Propose another place than this one, from now on."""
        self._skipped.append((self.proposed.x_mm, self.proposed.y_mm))
        self._proposed = None

    def _change(self, presses: MeasuredPresses) -> None:
        self._save(presses)
        self.presses, self._proposed = presses, None
        self._fit()

    def _fit(self) -> None:
        self.calibration, self.problem = None, ""
        if not len(self):
            return
        try:
            self.calibration = calibrate(self.presses, self.scene, self.before, warn=lambda _: None)
        except PressError as error:
            self.problem = str(error)

    @property
    def words(self) -> tuple[str, ...]:
        """How well the film is known by now, and which presses fit badly, a sentence each."""
        if self.problem:
            return (f"No film explains these presses: {self.problem}",)
        if self.calibration is None or len(self) < FEWEST_TO_SAY:
            return ()
        left, noise = self.calibration.left, self.calibration.sensitivity.of_noise()
        known = (
            f"{left.position_mm:.2g} mm and {left.force_percent:.2g} % are left by not knowing the film; "
            f"noise alone is {noise.position_mm:.2g} mm and {noise.force_percent:.2g} %."
        )
        return (known, *map(self._bad_words, self.calibration.bad_lines))

    def _bad_words(self, number: int) -> str:
        press = press_words(self.presses.contact[number - 1])
        return (
            f"Press {number}, {press}, fits no film that the others fit, and is left out: was it there, and as hard? "
            f"u {number} takes it back."
        )


def press_words(contact: Array) -> str:
    """A press (x_mm, y_mm, force_N), shape (3,), as "1.65 N at (3.0, 2.5) mm"; NaN is unknown."""
    x_mm, y_mm, force_N = contact.tolist()
    force = "an unknown force" if math.isnan(force_N) else f"{force_N:.2f} N"
    return f"{force} at an unknown place" if math.isnan(x_mm) else f"{force} at ({x_mm:.1f}, {y_mm:.1f}) mm"


def _no_presses(electrodes: tuple[str, ...]) -> MeasuredPresses:
    return MeasuredPresses(
        np.empty((0, 3)), np.empty((0, len(electrodes))), np.empty(0), np.empty(0), tuple(electrodes), ()
    )


def _numbered(presses: MeasuredPresses) -> MeasuredPresses:
    """Presses that are numbered from 1."""
    return replace(presses, lines=tuple(range(1, len(presses) + 1)))
