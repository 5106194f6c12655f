"""The weights of the recognition of unknown frames, fitted on random boards.

Each weight in turn is made smaller and larger, and its best value is kept; the score is the number of boards whose
charges, number and clock are read from a short and damaged capture. Boards that the fit has not seen come last.

    python tests/benchmarks/fit_recognition.py [--boards 200] [--rounds 1]
"""

import argparse
import runpy
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from isocharge.serve.recognition.described import WEIGHTS, described_frames
from isocharge.serve.recognition.fields import Weights

BOARDS = runpy.run_path(str(Path(__file__).parents[1] / "serve" / "recognition" / "test_described.py"))
FACTORS = (0.5, 0.8, 1.25, 2.0)


def capture(seed):
    """A board, and what came of 25 to 120 of its frames, every 300th byte wrong."""
    board, rng = BOARDS["RandomBoard"](seed), np.random.default_rng(seed)
    frames = int(rng.integers(25, 120))
    data = np.frombuffer(board.data[: len(board.data) * frames // BOARDS["FRAMES"]], np.uint8).copy()
    hit = rng.random(len(data)) < 1 / 300
    data[hit] ^= rng.integers(1, 256, hit.sum(), dtype=np.uint8)
    return board, data.tobytes(), frames / BOARDS["RATE_HZ"]


def recognised(captures, weights: Weights) -> int:
    """Number of boards that are read right."""
    tables = [(board, described_frames([data], seconds, weights=weights)) for board, data, seconds in captures]
    return sum(
        table is not None and board.is_read_by(table) and board.has_number_and_clock_of(table)
        for board, table in tables
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--boards", type=int, default=200)
    parser.add_argument("--rounds", type=int, default=1)
    options = parser.parse_args()
    known, unseen = ([capture(seed) for seed in range(first, first + options.boards)] for first in (10_000, 20_000))
    weights, best = WEIGHTS, recognised(known, WEIGHTS)
    print(f"before: {best} of {options.boards}; unseen {recognised(unseen, weights)}")
    for name, value in list(asdict(weights).items()) * options.rounds:
        tried = [replace(weights, **{name: float(f"{factor * value:.2g}")}) for factor in FACTORS]
        counts = [recognised(known, one) for one in tried]
        print(
            f"{name} {value}: " + ", ".join(f"{getattr(one, name)}: {n}" for one, n in zip(tried, counts, strict=True))
        )
        if max(counts) > best:
            best, weights = max(counts), tried[int(np.argmax(counts))]
    print(f"after: {best} of {options.boards}; unseen {recognised(unseen, weights)}\n{weights}")


if __name__ == "__main__":
    main()
