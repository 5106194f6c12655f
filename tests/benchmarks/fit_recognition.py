"""Fit of the weights with which unknown frames are recognised, on random boards.

Each weight in turn is made smaller and larger, and its best value is kept. The score is the number of boards whose
charges, frame number and clock are recognised from a short and damaged capture. At the beginning and at the end, the
score is also computed for boards that are not used in the fit. With the present weights, 93 of 100 boards of the fit
and 95 of the other boards are recognised.

    python tests/benchmarks/fit_recognition.py [--boards 200]
"""

import runpy
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from shared import arguments

from isocharge.serve.recognition.fields import Weights
from isocharge.serve.recognition.recognise import WEIGHTS, described_frames_section

BOARDS = runpy.run_path(str(Path(__file__).parents[1] / "serve" / "recognition" / "test_described.py"))
"""Names of the test module that defines random boards."""

FACTORS = (0.5, 0.8, 1.25, 2.0)
"""Factors with which each weight is tried."""

FIT_SEED = 10_000
"""Seed of the first board of the fit."""

UNSEEN_SEED = 20_000
"""Seed of the first board that is not used in the fit."""

DAMAGED_SHARE = 1 / 300
"""Share of the bytes of a capture that are wrong."""


def is_recognised(seed: int, weights: Weights) -> bool:
    """Return whether a board is recognised from 25 to 120 of its frames, of which some bytes are wrong."""
    board = BOARDS["RandomBoard"](seed)
    rng = np.random.default_rng(seed)
    frame_count = int(rng.integers(25, 120))
    captured = board.data[: len(board.data) * frame_count // BOARDS["FRAMES"]]
    data = np.frombuffer(captured, np.uint8)
    wrong_bits = rng.integers(1, 256, len(data), dtype=np.uint8)
    is_damaged = rng.random(len(data)) < DAMAGED_SHARE
    damaged = data ^ (wrong_bits * is_damaged)
    table = described_frames_section([damaged.tobytes()], frame_count / BOARDS["RATE_HZ"], weights=weights)
    return table is not None and board.is_read_by(table) and board.has_number_and_clock_of(table)


def count_recognised(weights: Weights, first_seed: int, count: int) -> int:
    """Return how many boards with consecutive seeds are recognised."""
    return sum(is_recognised(seed, weights) for seed in range(first_seed, first_seed + count))


def main() -> None:
    count = arguments(__doc__, boards=200).boards
    weights = WEIGHTS
    best_score = count_recognised(weights, FIT_SEED, count)
    print(f"before: {best_score} of {count}; unseen: {count_recognised(weights, UNSEEN_SEED, count)}")
    for name, value in asdict(weights).items():
        scores = {}
        for factor in FACTORS:
            tried_value = round(factor * value, 3)
            scores[tried_value] = count_recognised(replace(weights, **{name: tried_value}), FIT_SEED, count)
        print(f"{name} {value}: " + ", ".join(f"{tried_value}: {score}" for tried_value, score in scores.items()))
        best_value = max(scores, key=lambda tried_value: scores[tried_value])
        if scores[best_value] > best_score:
            best_score = scores[best_value]
            weights = replace(weights, **{name: best_value})
    print(f"after: {best_score} of {count}; unseen: {count_recognised(weights, UNSEEN_SEED, count)}\n{weights}")


if __name__ == "__main__":
    main()
