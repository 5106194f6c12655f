"""What `Predictor` offers in process: one press in two manners, and batches."""

from collections.abc import Sequence
from itertools import cycle

import numpy as np

from isocharge.common.arrays import Singles
from isocharge.serve.benchmark.timing import Contender
from isocharge.serve.prediction.predictor import Predictor

BATCHES = (16, 256, 4096)
"""Presses in a batch; the last is the largest that a server takes by default."""

CHARGES = 4096
"""Presses that the calls cycle through."""


def press_charges(golden_pC: Singles, seed: int, presses: int = CHARGES) -> Singles:
    """Presses drawn from the golden vectors of a model, shapes (presses, electrodes) from (n, electrodes), pC."""
    charges: Singles = golden_pC[np.random.default_rng(seed).integers(0, len(golden_pC), presses)]
    return charges


def in_process_contenders(
    predictor: Predictor, charge_pC: Singles, batches: Sequence[int] = BATCHES
) -> list[Contender]:
    """Every method of a predictor.

    Args:
        predictor: The model.
        charge_pC: Shape (n, electrodes), pC; each call of one press takes the next row.
        batches: Presses of the batches; those above n are left out.
    """
    rows, lists, out = cycle(charge_pC), cycle(charge_pC.tolist()), np.zeros(7, np.float32)
    contenders = [
        Contender("predict_into, float32 array", 1, lambda: predictor.predict_into(next(rows), out)),
        Contender("predict, list of numbers", 1, lambda: predictor.predict(next(lists))),
    ]
    return contenders + [_batch(predictor, charge_pC[:n]) for n in batches if n <= len(charge_pC)]


def _batch(predictor: Predictor, charge_pC: Singles) -> Contender:
    return Contender(f"predict_batch, {len(charge_pC)}", len(charge_pC), lambda: predictor.predict_batch(charge_pC))
