"""Any server of the Open Inference Protocol, asked by Triton's stock client: are its answers right, and how fast?

    python serve/deploy/check_host.py 127.0.0.1:8000 [--models models] [--seconds 2] [--connections 4] [--json]

The golden vectors of every model of the folder go to the server, one by one and as a batch, and the answers are
compared with `golden.json` within its tolerance (one by one: twice). Then one press is asked for again and again, as
JSON, one at a time and over several connections. Needs numpy and tritonclient[http]; exit code 1 if an answer is wrong.
"""

import argparse
import json
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import tritonclient.http as triton

ONE_BY_ONE = 2.0
"""Tolerances by which a row alone may differ: golden.json was computed as a batch, which rounds in another order."""


def ask(
    client: triton.InferenceServerClient, model: str, charges: np.ndarray, outputs: list[str]
) -> dict[str, np.ndarray]:
    """Outputs by name for charges of shape (n, electrodes), pC."""
    tensor = triton.InferInput("charge_pC", list(charges.shape), "FP32")
    tensor.set_data_from_numpy(charges, binary_data=False)
    requested = [triton.InferRequestedOutput(name, binary_data=False) for name in outputs]
    answer = client.infer(model, [tensor], outputs=requested)
    return {name: answer.as_numpy(name) for name in outputs}


def golden_ratios(client: triton.InferenceServerClient, golden: dict[str, Any], model: str) -> tuple[float, float]:
    """The largest difference from the golden answers over its tolerance: of the whole batch, and row by row."""
    charges, names = np.array(golden["inputs"]["charge_pC"], np.float32), list(golden["outputs"])
    rows = [ask(client, model, row[np.newaxis], names) for row in charges]
    single = {name: np.concatenate([row[name] for row in rows]) for name in names}
    return _ratio(ask(client, model, charges, names), golden), _ratio(single, golden)


def _ratio(answers: dict[str, np.ndarray], golden: dict[str, Any]) -> float:
    ratios = []
    for name, rows in golden["outputs"].items():
        expected = np.array(rows)
        allowed = golden["tolerance"]["relative"] * np.maximum(np.abs(expected), golden["tolerance"]["floor"][name])
        same = answers[name].shape == expected.shape
        ratios.append(np.max(np.abs(answers[name] - expected) / allowed) if same else np.inf)
    return float(np.max(ratios))  # NaN stays NaN, and is below no limit


def durations(url: str, model: str, charges: np.ndarray, seconds: float) -> list[float]:
    """Times of requests of one press one after another on a connection of its own, s; the first ones warm up."""
    times: list[float] = []
    with triton.InferenceServerClient(url) as client:
        for _ in range(20):
            ask(client, model, charges, ["contact"])
        end = time.perf_counter() + seconds
        while (begin := time.perf_counter()) < end:
            ask(client, model, charges, ["contact"])
            times.append(time.perf_counter() - begin)
    return times


def check(url: str, models: Path, seconds: float, connections: int) -> dict[str, Any]:
    """What the report says."""
    goldens = {path.parents[1].name: json.loads(path.read_text()) for path in sorted(models.glob("*/1/golden.json"))}
    with triton.InferenceServerClient(url) as client:
        served = {name: golden for name, golden in goldens.items() if client.is_model_ready(name)}
        ratios = {name: golden_ratios(client, golden, name) for name, golden in served.items()}
    name, golden = next(iter(served.items()))
    press = np.array(golden["inputs"]["charge_pC"][:1], np.float32)
    times = durations(url, name, press, seconds)
    with ThreadPoolExecutor(connections) as pool:
        jobs = [pool.submit(durations, url, name, press, seconds) for _ in range(connections)]
        answers = sum(len(job.result()) for job in jobs)
    p50, p99 = np.percentile(times, (50, 99)) * 1e6
    return {
        "url": url,
        "difference_over_tolerance": {name: batch for name, (batch, _) in ratios.items()},
        "one_by_one": {name: single for name, (_, single) in ratios.items()},
        "not_served": sorted(set(goldens) - set(served)),
        "p50_us": round(float(p50), 1),
        "p99_us": round(float(p99), 1),
        "per_second": round(answers / seconds),
        "connections": connections,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("url", help="HOST:PORT of HTTP")
    parser.add_argument("--models", type=Path, default=Path("models"), help="folder with the golden vectors")
    parser.add_argument("--seconds", type=float, default=2.0, help="of each measurement")
    parser.add_argument("--connections", type=int, default=4)
    parser.add_argument("--json", action="store_true", help="one JSON object")
    asked = parser.parse_args()
    report = check(asked.url, asked.models, asked.seconds, asked.connections)
    if asked.json:
        print(json.dumps(report))
    else:
        print("\n".join(f"{name:26s} {value}" for name, value in report.items()))
    if report["not_served"] or not is_right(report):
        sys.exit(1)


def is_right(report: dict[str, Any]) -> bool:
    """Whether all answers are within their limits."""
    limits = {"difference_over_tolerance": 1.0, "one_by_one": ONE_BY_ONE}
    return all(ratio <= limit for key, limit in limits.items() for ratio in report[key].values())


if __name__ == "__main__":
    main()
