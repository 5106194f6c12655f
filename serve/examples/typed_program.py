"""
How do I write a program with types?
====================================

This program counts the touches of a board and prints the hardest of them. ``mypy --strict`` and pyright accept it. Each
name that it imports has types, so an editor shows the fields of a record and the type checkers find a misspelt field.
``python serve/examples/typed_program.py FILE`` reads the frames in a file or from a port, instead of the simulated
frames.
"""

import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from isocharge.serve import Chunk, Contact, PredictionRecord, Predictor, open_source, stream

RATE_HZ = 200.0


@dataclass(frozen=True)
class Touch:
    """The record of a touch with the largest force, and the number of its frames."""

    hardest: PredictionRecord
    frames: int


def touches(records: Iterable[PredictionRecord]) -> Iterator[Touch]:
    """Yield each touch when it has ended."""
    touch: Touch | None = None
    for record in records:
        if record.contact and record.force_N is not None:
            if touch is None or touch.hardest.force_N is None or record.force_N > touch.hardest.force_N:
                hardest = record
            else:
                hardest = touch.hardest
            touch = Touch(hardest, 1 if touch is None else touch.frames + 1)
        elif touch is not None and record.force_N == 0.0:  # an invalid frame has the force None
            yield touch
            touch = None


def simulated_chunks() -> Iterator[Chunk]:
    """Yield the lines of a board on which the same place is pressed twice, softly and hard."""
    released = (0.0, 0.0, 0.0)
    soft_press = (593.9, 573.5, 435.2)  # pC on the electrodes A, B and C
    hard_press = (942.9, 910.4, 690.8)
    charges_pC = [released] * 200
    for press in (soft_press, hard_press):
        charges_pC += [press] * 100 + [released] * 200
    for number, charge_pC in enumerate(charges_pC):
        line = ",".join(f"{charge:.1f}" for charge in charge_pC)
        yield Chunk(f"{line}\n".encode(), number / RATE_HZ, 0)


predictor = Predictor("three-25um-biaxial")
contact: Contact = predictor.predict([593.9, 573.5, 435.2])
print(f"one press: {contact.force_N:.2f} N")

if len(sys.argv) > 1:
    with open_source(sys.argv[1]) as source:
        found = list(touches(stream(source, predictor)))
else:
    found = list(touches(stream(simulated_chunks(), predictor)))
for touch in found:
    print(f"{touch.frames} frames, at most {touch.hardest.force_N:.2f} N")
