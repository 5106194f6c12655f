"""One press: the exported C against `session.run` of the same model in the same process, in turns.

    python tests/benchmarks/bench_c.py [--model NAME|PATH] [--seconds 10] [--calls 2000] [--compiler gcc] [--json]

The C is compiled as a library, once for each set of options, and loaded with ctypes; the loop over presses is in C, as
in a host program without Python. The session has one thread and gets its input arrays ready-made. Beside the times
stand how far the answers are from those of session.run, relative to max(|b|, 1 mm or 0.1 N), and the model's own error.
"""

import ctypes
import subprocess
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from shared import options, print_results

from isocharge.serve import find_model, load_model
from isocharge.serve.benchmark import Contender, take_turns
from isocharge.train.export_c.folder import export_c

OPTIONS = ("-O2", "-O3 -march=native", "-O3 -march=native -ffp-contract=fast")

PRESSES = 512
"""Different presses that the calls go through."""

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


def compiled(export: Path, compiler: str, options: str) -> Callable[[np.ndarray, int, np.ndarray], None]:
    """The loop over presses of an export, compiled with some options."""
    (export / "loop.c").write_text(LOOP)
    library = export / f"loop{OPTIONS.index(options)}.so"
    words = [compiler, "-std=c99", *options.split(), "-fPIC", "-shared", "loop.c", "isocharge_model.c", "-lm"]
    subprocess.run([*words, "-o", library], cwd=export, check=True)
    function = ctypes.CDLL(str(library)).loop

    def loop(charge_pC: np.ndarray, calls: int, contact: np.ndarray) -> None:
        function(ctypes.c_void_p(charge_pC.ctypes.data), len(charge_pC), calls, ctypes.c_void_p(contact.ctypes.data))

    return loop


def measure(model: Any, loops: dict[str, Any], seconds: float, calls: int, seed: int) -> list[dict[str, Any]]:
    """A row for each contender."""
    charge_pC = np.random.default_rng(seed).uniform(300.0, 1500.0, (PRESSES, len(model.metadata.electrodes)))
    charge_pC = np.ascontiguousarray(charge_pC, dtype=np.float32)
    feeds = [{"charge_pC": row[np.newaxis]} for row in charge_pC]
    expected = np.array([np.concatenate(model.session.run(None, feed), axis=1)[0] for feed in feeds])
    contact = np.empty_like(expected)

    def sessions() -> None:
        for k in range(calls):
            model.session.run(None, feeds[k % PRESSES])

    contenders, apart = [Contender("session.run", calls, sessions)], {"session.run": 0.0}
    for name, loop in loops.items():
        loop(charge_pC, PRESSES, contact)
        apart[name] = float(np.max(np.abs(contact - expected) / np.maximum(np.abs(expected), FLOORS)))
        contenders.append(Contender(name, calls, partial(loop, charge_pC, calls, contact)))
    bare, *others = take_turns(contenders, seconds)
    return [
        {
            "call": timing.name,
            "p50_us": round(timing.p50_us / calls, 3),
            "p99_us": round(timing.p99_us / calls, 3),
            "ratio_p50": round(timing.p50_us / bare.p50_us, 3),
            "largest_difference": apart[timing.name],
        }
        for timing in (bare, *others)
    ]


def main() -> None:
    asked = options(__doc__, "four-25um-biaxial", seconds=10.0, calls=2000, compiler="gcc")
    model = load_model(find_model(asked.model))
    compiler = subprocess.check_output([asked.compiler, "--version"], text=True).splitlines()[0]
    with tempfile.TemporaryDirectory() as folder:
        export = export_c(model.folder, Path(folder) / "c")
        loops = {f"C {flags}": compiled(export, asked.compiler, flags) for flags in OPTIONS}
        table = measure(model, loops, asked.seconds, asked.calls, asked.seed)
    error_mm = model.metadata.errors.get("position_rms_mm")
    print_results("c", asked, {"compiler": compiler, "position_rms_mm": error_mm, "one press": table})


if __name__ == "__main__":
    main()
