"""One press: `Predictor` and the exported C against a bare `session.run` of the same model, in turns in one process.

    python tests/benchmarks/bench_predictor.py [--model NAME|PATH] [--seconds 10] [--calls 2000] [--json]

The bare session has the same options as ours (one thread, no spinning) and gets its input array ready-made. The C is
compiled as a library, once for each set of options, and loaded with ctypes; the loop over presses is in C, as in a host
program without Python. Beside its times stands how far its answers are from the model's, relative to max(|b|, 1 mm or
0.1 N).
"""

import ctypes
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from shared import in_turns, options, print_results

from isocharge.serve import Predictor, find_model
from isocharge.serve.benchmark import Contender
from isocharge.serve.model.session import open_session
from isocharge.train.export_c.folder import export_c

FLAGS = ("-O2", "-O3 -march=native", "-O3 -march=native -ffp-contract=fast")

PRESSES = 512
"""Different presses that the loops in C go through."""

FLOORS = np.array([1.0, 1.0, 0.1, 1.0, 1.0, 0.1, 20.0])
"""Floors of golden vectors: mm, mm, N, their deviations, and the misfit."""

LOOP = """
#include "isocharge_model.h"

void loop(const float *charge_pC, int presses, int calls, float *contact)
{
    for (int k = 0; k < calls; ++k)
        isocharge_predict(charge_pC + (k % presses) * ISOCHARGE_ELECTRODES, contact + 7 * (k % presses));
}
"""


def in_process(predictor: Predictor, charge_pC: np.ndarray) -> list[Contender]:
    """The session and every way of the predictor, with one press."""
    folder = predictor.folder
    session = open_session((folder / "model.onnx").read_bytes(), str(folder))
    feed, values, out = {"charge_pC": charge_pC[np.newaxis]}, charge_pC.tolist(), np.zeros(10, np.float32)
    return [
        Contender("session.run", 1, lambda: session.run(None, feed)),
        Contender("predict_into", 1, lambda: predictor.predict_into(charge_pC, out)),
        Contender("predict(list)", 1, lambda: predictor.predict(values)),
        Contender("predict(array)", 1, lambda: predictor.predict(charge_pC)),
    ]


def in_c(export: Path, flags: str, calls: int, charge_pC: np.ndarray, contact: np.ndarray) -> Contender:
    """The loop over presses, compiled with some options; a call leaves its answers in `contact`."""
    (export / "loop.c").write_text(LOOP)
    library = export / f"loop{FLAGS.index(flags)}.so"
    words = ["gcc", "-std=c99", *flags.split(), "-fPIC", "-shared", "loop.c", "isocharge_model.c", "-lm"]
    subprocess.run([*words, "-o", library], cwd=export, check=True)
    loop, pointers = ctypes.CDLL(str(library)).loop, [ctypes.c_void_p(x.ctypes.data) for x in (charge_pC, contact)]
    return Contender(f"C {flags}", calls, lambda: loop(pointers[0], PRESSES, calls, pointers[1]))


def main() -> None:
    asked = options(__doc__, seconds=10.0, calls=2000)
    predictor = Predictor(find_model(asked.model))
    shape = PRESSES, len(predictor.metadata.electrodes)
    charge_pC = np.random.default_rng(asked.seed).uniform(300.0, 1500.0, shape).astype(np.float32)
    expected, contact = np.column_stack(predictor.predict_batch(charge_pC))[:, :7], np.zeros((PRESSES, 7), np.float32)
    contenders, differences = in_process(predictor, charge_pC[0]), {}
    with tempfile.TemporaryDirectory() as folder:
        if shutil.which("gcc"):
            export = export_c(predictor.folder, Path(folder) / "c")
            contenders += [in_c(export, flags, max(asked.calls, PRESSES), charge_pC, contact) for flags in FLAGS]
        else:
            print("left out: C: there is no gcc", file=sys.stderr)
        for contender in contenders[4:]:
            contender.call()
            differences[contender.name] = float(
                np.max(np.abs(contact - expected) / np.maximum(np.abs(expected), FLOORS))
            )
        results = {"one press": in_turns(contenders, asked.seconds), "largest difference": differences}
    print_results("predictor", asked, results)


if __name__ == "__main__":
    main()
