"""An exported graph against the network that it was made from, and its golden vectors."""

import numpy as np

from isocharge.common.arrays import Singles
from isocharge.common.errors import TrainingError
from isocharge.serve.model.session import open_session, run
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.train.data.presses import HIGHEST_CHARGE, LOWEST_CHARGE, LabelledPresses
from isocharge.train.model_release.evaluate import Predict

GOLDEN = 64
"""Golden vectors per model: half clean, a quarter noisy, a quarter absurd."""

AGREEMENT = {
    "contact": (np.array([1.0, 1.0, 0.1]), 1e-5),
    "contact_std": (np.array([1.0, 1.0, 0.1]), 1e-5),
    "misfit": (np.array([1.0]), 2e-4),
}
"""By output: unit below which differences count absolutely, and how far file and network may be apart (float32)."""

COMPARED = 10_000
"""Noisy presses on which file and network are compared."""

NEARLY_ALL = 0.999
"""Share of the presses that the limits are for: where charges tell little, a float32 has not the digits."""

ABSURD = 10.0
"""Factor on the limits for all other presses, and for charges that no film gives."""


def check_graph(graph: bytes, exact: Predict, presses: LabelledPresses, noise: NoiseModel) -> Singles:
    """Compare a graph with the network that it was made from.

    Args:
        graph: The ONNX file.
        exact: The network in double precision.
        presses: Presses of the film.
        noise: Noise of good presses.

    Returns:
        Charges for the golden vectors, float32, shape (GOLDEN, n_electrode), pC.

    Raises:
        TrainingError: If an answer is not finite, or file and network disagree.
    """
    good, absurd = _golden_charges(exact, presses, noise)
    _check_finite(graph, presses.charge.shape[1])
    _compare(graph, exact, absurd, ABSURD)
    rows = np.arange(COMPARED) % len(presses)
    _compare(graph, exact, presses[rows].noisy(noise, seed=3).astype(np.float32), 1.0)
    return np.concatenate([good, absurd])


def _golden_charges(exact: Predict, presses: LabelledPresses, noise: NoiseModel) -> tuple[Singles, Singles]:
    """Charges for the golden vectors: GOLDEN * 3 / 4 of presses, and absurd ones, shape (n, n_electrode).

    They are chosen where charges tell the position better than the median: where 0.2 % is a millimetre, the last digit
    of a float32 is 3e-5 mm, and no two runtimes agree to the tolerance of golden vectors.
    """
    std = exact(presses.charge)[1]
    sure = presses[np.flatnonzero(std[:, 0] + std[:, 1] <= np.median(std[:, 0] + std[:, 1]))]
    clean = sure[np.linspace(0, len(sure) - 1, GOLDEN // 2).astype(int)]
    half = clean[np.arange(0, len(clean), 2)]
    noisy = half.noisy(noise, seed=2)
    absurd = half.charge * np.geomspace(1e-3, 1e3, len(half))[:, None]
    absurd[0], absurd[1] = 0.0, -absurd[1]
    return np.concatenate([clean.charge, noisy]).astype(np.float32), absurd.astype(np.float32)


def _check_finite(graph: bytes, n_electrode: int) -> None:
    """The graph goes on straight in the logarithms beyond its presses: its answers must stay finite up to the ends.

    Raises:
        TrainingError: If one does not.
    """
    ends = np.random.default_rng(4).choice([LOWEST_CHARGE, HIGHEST_CHARGE], (COMPARED, n_electrode)).astype(np.float32)
    for name, rows in run(open_session(graph, "the exported graph"), ends).items():
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if bad.size:
            raise TrainingError(
                f"the network answers {name} = {rows[bad[0]]} to the charges {ends[bad[0]]} pC; expected finite "
                "numbers for any charges: train with more steps or another seed"
            )


def _compare(graph: bytes, exact: Predict, charge: Singles, slack: float) -> None:
    """The file must answer as the network does."""
    answers = run(open_session(graph, "the exported graph"), charge)
    for mine, (name, theirs) in zip(exact(charge.astype(float)), answers.items(), strict=True):
        unit, limit = AGREEMENT[name]
        apart = np.max(np.abs(mine - theirs) / np.maximum(np.abs(mine), unit), axis=1)
        nearly_all, all_of_them = float(np.quantile(apart, NEARLY_ALL)), float(apart.max())
        if not (nearly_all <= slack * limit and all_of_them <= ABSURD * limit):
            raise TrainingError(
                f"the exported graph disagrees with the network on {name}: expected at most {slack * limit:g} for "
                f"{NEARLY_ALL:.1%} of the charges and {ABSURD * limit:g} for all, got {nearly_all:.2g} and "
                f"{all_of_them:.2g}"
            )
