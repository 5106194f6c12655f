"""How much work a report is."""

from dataclasses import dataclass

from isocharge.simulate.mechanics.theory import ACCURACY


@dataclass(frozen=True)
class Settings:
    """Sizes of a report.

    Attributes:
        presses: Test presses.
        hold_out: Share of the dataset's positions that hyperparameters are chosen by.
        learn_from: Presses of the dataset that are used at most.
        sizes: Hidden layers of the networks.
        steps: Their optimiser steps.
        seconds: Time in which single predictions of a method are timed, and the same for batches, s.
        batch: Presses in a batch.
        draws: Draws of the noise for maps and coverage of the released model.
        limited: Test presses that the Bayes limit is integrated for.
        accuracy: Relative error of a charge in the films that are solved.
        shapes: Probes that the models do not expect, as notations.
        mismatch_cases: Whether other pretensions and presses outside the working area are tried; both take solves.
        seed: Of everything random.
        quick: Whether methods are fitted small.
    """

    presses: int = 4096
    hold_out: float = 0.1
    learn_from: int = 200_000
    sizes: tuple[tuple[int, ...], ...] = ((16, 16), (32, 32), (64, 64, 64), (128, 128, 128))
    steps: int = 4_000
    seconds: float = 0.1
    batch: int = 4096
    draws: int = 20
    limited: int = 4096
    accuracy: float = ACCURACY
    shapes: tuple[str, ...] = ("circle:0.5", "circle:1.5", "circle:2.0", "rectangle:4.0x2.0", "triangle:4.0")
    mismatch_cases: bool = True
    seed: int = 0
    quick: bool = False


QUICK = Settings(
    presses=512,
    learn_from=3000,
    sizes=((16, 16),),
    steps=150,
    seconds=0.01,
    batch=512,
    draws=4,
    limited=128,
    accuracy=1e-2,
    shapes=("circle:2.0",),
    mismatch_cases=False,
    quick=True,
)
"""Everything once, small: seconds, to try it out. Its figures mean nothing."""
