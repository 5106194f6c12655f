"""Two touches at the same time: how many of them carry a flag, for each released model.

    python tests/benchmarks/bench_pairs.py [--models NAME,...] [--pairs 100] [--apart 8.0] [--limit] [--seed 1]
        [--json]

Both loads act on the film at the same time. An independent solver computes the charges (tests/membrane_solver.py: a
membrane without bending, quadratic triangles; about 1 s of CPU time for a pair). The touches lie in the working area of
the model, have 0.1 to 1 N each, and are at least `--apart` mm apart. Some pairs have charges that a single press in the
working area also has within five standard deviations of the noise. With `--limit`, `detectable` is the share of the
other pairs.
"""

import sys
from dataclasses import asdict
from pathlib import Path

from shared import arguments, print_results

sys.path.insert(0, str(Path(__file__).parents[1]))

from touch_pairs import PairStudy

RELEASED = (
    "three-25um-biaxial,four-25um-biaxial,four-25um-uniaxial,four-25um-biaxial-15mm,three-25um-biaxial-12mm,"
    "eight-25um-biaxial,six-25um-biaxial-30mm,eight-25um-biaxial-36mm"
)


def main() -> None:
    requested = arguments(__doc__, models=RELEASED, pairs=100, apart=8.0, limit=False, seed=1, json=False)
    results = {}
    for model in requested.models.split(","):
        study = PairStudy(model)
        shares = study.shares(requested.pairs, requested.apart, requested.seed, with_limit=requested.limit)
        results[model] = {name: round(value, 1) for name, value in asdict(shares).items()}
        print(model, results[model], file=sys.stderr, flush=True)
    print_results("pairs", requested, results)


if __name__ == "__main__":
    main()
