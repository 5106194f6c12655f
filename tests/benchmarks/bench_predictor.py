"""One press: `Predictor.predict_into` and `predict` against a bare `session.run`, same model, in interleaved rounds.

    python tests/benchmarks/bench_predictor.py [--model NAME|PATH] [--rounds 30] [--calls 2000] [--json]

The bare session has the same options as ours (one thread, no spinning) and gets its input array ready-made.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from isocharge.serve import Predictor, find_model
from isocharge.serve.benchmark import machine
from isocharge.serve.model.session import open_session


def microseconds(call: Callable[[], object], calls: int) -> np.ndarray:
    """Duration of each of many calls, us."""
    clock, durations = time.perf_counter_ns, np.empty(calls)
    for i in range(calls):
        begin = clock()
        call()
        durations[i] = clock() - begin
    return durations / 1e3


def contenders(model: str, seed: int) -> dict[str, Callable[[], object]]:
    """What is compared, each with one press."""
    folder = find_model(model)
    predictor = Predictor(folder)
    session = open_session((folder / "model.onnx").read_bytes(), str(folder))
    charge_pC = np.random.default_rng(seed).uniform(500.0, 1500.0, len(predictor.metadata.electrodes))
    feed, values = {"charge_pC": np.float32(charge_pC[np.newaxis])}, charge_pC.tolist()
    singles, out = np.float32(charge_pC), np.zeros(7, np.float32)
    return {
        "session.run": lambda: session.run(None, feed),
        "predict_into": lambda: predictor.predict_into(singles, out),
        "predict(list)": lambda: predictor.predict(values),
        "predict(array)": lambda: predictor.predict(charge_pC),
    }


def measure(calls: dict[str, Callable[[], object]], rounds: int, number: int) -> dict[str, np.ndarray]:
    """Durations of each contender, shape (rounds, number), us; the first round only warms up and is thrown away."""
    kept: dict[str, list[np.ndarray]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            kept[name].append(microseconds(call, number))
    return {name: np.array(durations[1:]) for name, durations in kept.items()}


def rows(durations: dict[str, np.ndarray]) -> Iterator[dict[str, Any]]:
    """A line for each contender; the ratio is the median over rounds, with its smallest and largest."""
    bare = np.median(durations["session.run"], axis=1)
    for name, of in durations.items():
        ratio = np.median(of, axis=1) / bare
        p50, p99 = np.percentile(of, (50, 99))
        yield {
            "call": name,
            "p50_us": round(float(p50), 2),
            "p99_us": round(float(p99), 2),
            "ratio_p50": round(float(np.median(ratio)), 3),
            "ratio_range": [round(float(ratio.min()), 3), round(float(ratio.max()), 3)],
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="three-25um-biaxial", help="model name or path")
    parser.add_argument("--rounds", type=int, default=30)
    parser.add_argument("--calls", type=int, default=2000, help="calls of each contender in a round")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="one JSON object")
    asked = parser.parse_args()
    table = list(rows(measure(contenders(asked.model, asked.seed), asked.rounds, asked.calls)))
    if asked.json:
        print(json.dumps({"benchmark": "predictor", **vars(asked), "machine": machine(), "results": table}))
        return
    print(", ".join(f"{name} {value}" for name, value in machine().items()))
    print(f"{asked.model}: {asked.rounds} rounds of {asked.calls} calls, after one to warm up; seed {asked.seed}")
    for row in table:
        low, high = row["ratio_range"]
        times = f"p50 {row['p50_us']:6.2f} us   p99 {row['p99_us']:6.2f} us"
        print(f"{row['call']:15s} {times}   ratio of p50 {row['ratio_p50']:.2f} ({low:.2f} to {high:.2f} over rounds)")


if __name__ == "__main__":
    main()
