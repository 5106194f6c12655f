"""The live path over a pseudo-terminal: frames lost and repeated, and how long a prediction takes to come.

    python tests/benchmarks/bench_stream.py [--model NAME|PATH] [--seconds 60] [--rate-Hz 200] [--json]

Two latencies: from the virtual sensor's write to the record (kernel, port, parser, chain, model), and from the arrival
of the last byte to the record, as the record itself says. Sensor and reader share this process and its interpreter
lock. The charges are those of a made-up linear film: nothing here depends on what the model answers.
"""

import argparse
import json
import time
from itertools import islice
from typing import Any

import numpy as np
from bench_predictor import machine

from isocharge.serve import BinaryParser, Port, Predictor, SequenceGaps, VirtualSensor, stream, wander


def reference_noise(charge_pC: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """1 pC and 0.2 % on each channel."""
    return charge_pC + np.hypot(1.0, 0.002 * charge_pC) * rng.standard_normal(charge_pC.shape)


def play(predictor: Predictor, seconds: float, rate_Hz: float, seed: int) -> dict[str, Any]:
    """Follow a virtual sensor for a while."""
    electrodes = len(predictor.metadata.electrodes)
    direction = np.exp(2j * np.pi * np.arange(electrodes) / electrodes)

    def charge_pC(x_mm: np.ndarray, y_mm: np.ndarray, force_N: np.ndarray) -> np.ndarray:
        return 800.0 * force_N[:, None] * (1.0 + ((x_mm + 1j * y_mm)[:, None] * direction.conj()).real / 20.0)

    script = wander(seed=seed, seconds=min(seconds, 60.0), rate_Hz=rate_Hz)
    parser, gaps, latencies = BinaryParser(), SequenceGaps(), []
    with VirtualSensor(charge_pC, script, noise=reference_noise, seed=seed) as sensor, Port(sensor.url) as port:
        for record in islice(stream(port, predictor, parser=parser, gaps=gaps), round(seconds * rate_Hz)):
            written = sensor.truth(record.seq).sent_s
            latencies.append(((time.perf_counter() - written) * 1e6, record.latency_us, record.contact))
        withheld = sensor.withheld
    return summary(np.array(latencies, dtype=float), parser, gaps, withheld)


def summary(latencies: np.ndarray, parser: BinaryParser, gaps: SequenceGaps, withheld: int) -> dict[str, Any]:
    """Counters and percentiles; latencies has the columns write to record, last byte to record (us), contact."""
    touched = latencies[latencies[:, 2] == 1.0]
    return {
        "frames": parser.counts.frames,
        "lost": gaps.lost,
        "repeated": gaps.repeated,
        "withheld": withheld,
        "crc_errors": parser.counts.crc_errors,
        "malformed": parser.counts.malformed,
        "in_contact": len(touched),
        "write_to_record_us": percentiles(touched[:, 0]),
        "last_byte_to_record_us": percentiles(touched[:, 1]),
    }


def percentiles(values: np.ndarray) -> dict[str, float]:
    return {f"p{p:g}": round(float(np.percentile(values, p)), 1) for p in (50, 99, 99.9)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", default="three-25um-biaxial", help="model name or path")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate-Hz", type=float, default=200.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="one JSON object")
    asked = parser.parse_args()
    result = play(Predictor(asked.model), asked.seconds, asked.rate_Hz, asked.seed)
    if asked.json:
        print(json.dumps({"benchmark": "stream", **vars(asked), "machine": machine(), "results": result}))
        return
    print(", ".join(f"{name} {value}" for name, value in machine().items()))
    print(f"{asked.model}: {asked.seconds:g} s at {asked.rate_Hz:g} Hz, seed {asked.seed}; latencies in contact")
    for name, value in result.items():
        print(f"{name:24s} {value}")


if __name__ == "__main__":
    main()
