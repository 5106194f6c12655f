"""One press: `Predictor.predict_into` and `predict` against a bare `session.run`, same model, in interleaved rounds.

    python tests/benchmarks/bench_predictor.py [--model NAME|PATH] [--rounds 30] [--calls 2000] [--json]

The bare session has the same options as ours (one thread, no spinning) and gets its input array ready-made.
"""

from collections.abc import Callable

import numpy as np
from shared import options, print_results, rows, take_turns

from isocharge.serve import Predictor, find_model
from isocharge.serve.model.session import open_session


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


def main() -> None:
    asked = options(__doc__, rounds=30, calls=2000)
    durations = take_turns(contenders(asked.model, asked.seed), asked.rounds, asked.calls)
    print_results("predictor", asked, {"one press": list(rows(durations, "session.run"))})


if __name__ == "__main__":
    main()
