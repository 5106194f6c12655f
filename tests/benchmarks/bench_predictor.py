"""One press: `Predictor` and the exported C against a bare `session.run` of the same model, in turns in one process.

    python tests/benchmarks/bench_predictor.py [--model NAME|PATH] [--seconds 10]

The bare session has the options of the predictor (one thread, no spinning) and gets its input array ready-made. The C
is compiled as a library, once for each set of options, and called through ctypes; the loop over presses is in C, as in
a host program without Python. The largest difference of its contacts from those of the model is relative to max(|b|,
1 mm or 0.1 N).
"""

import ctypes
import subprocess
import tempfile
from functools import partial
from pathlib import Path

import numpy as np
from shared import in_turns, options, print_results

from isocharge.serve import Predictor, find_model
from isocharge.serve.benchmark import Contender
from isocharge.serve.model.session import open_session
from isocharge.train.export_c.folder import export_c

OPTIONS = ("-O2", "-O3 -march=native -ffp-contract=fast")
"""Options of the compiler."""

PRESSES = 2000
"""Number of presses of a loop in C."""

FLOORS = np.array([1.0, 1.0, 0.1, 1.0, 1.0, 0.1, 20.0])
"""Smallest divisors of differences: mm, mm, N, their standard deviations, and the misfit."""

LOOP = """
#include "isocharge_model.h"

void loop(const float *charge_pC, int presses, float *contact)
{
    for (int k = 0; k < presses; ++k)
        isocharge_predict(charge_pC + k * ISOCHARGE_ELECTRODES, contact + 7 * k);
}
"""


def main() -> None:
    asked = options(__doc__, seconds=10.0)
    predictor = Predictor(find_model(asked.model))
    shape = (PRESSES, len(predictor.metadata.electrodes))
    charge_pC = np.random.default_rng(asked.seed).uniform(300.0, 1500.0, shape).astype(np.float32)
    expected = np.column_stack(predictor.predict_batch(charge_pC))[:, :7]
    contact = np.zeros((PRESSES, 7), np.float32)

    session = open_session((predictor.folder / "model.onnx").read_bytes(), str(predictor.folder))
    feed = {"charge_pC": charge_pC[:1]}
    first_charge_pC = charge_pC[0]
    out = np.zeros(10, np.float32)
    contenders = [
        Contender("session.run", 1, lambda: session.run(None, feed)),
        Contender("predict_into", 1, lambda: predictor.predict_into(first_charge_pC, out)),
    ]
    differences = {}
    with tempfile.TemporaryDirectory() as folder:
        export = export_c(predictor.folder, Path(folder) / "c")
        (export / "loop.c").write_text(LOOP)
        arguments = ctypes.c_void_p(charge_pC.ctypes.data), PRESSES, ctypes.c_void_p(contact.ctypes.data)
        for number, words in enumerate(OPTIONS):
            library = export / f"loop{number}.so"
            command = f"gcc -std=c99 {words} -fPIC -shared loop.c isocharge_model.c -lm -o {library}"
            subprocess.run(command.split(), cwd=export, check=True)
            loop = partial(ctypes.CDLL(str(library)).loop, *arguments)
            loop()
            difference = np.abs(contact - expected) / np.maximum(np.abs(expected), FLOORS)
            differences[words] = float(difference.max())
            contenders.append(Contender(f"C {words}", PRESSES, loop))
        results = {"one press": in_turns(contenders, asked.seconds), "largest difference": differences}
    print_results("predictor", asked, results)


if __name__ == "__main__":
    main()
