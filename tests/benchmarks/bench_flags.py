"""Which faults of presses inside the working area the released models flag: a table of serve/docs/unnoticed.md.

    python tests/benchmarks/bench_flags.py [--models NAME,...] [--presses 4000] [--seed 1] [--json]

Presses of a circle of 1 mm over the whole range of forces, 0.05 to 2 N, with `reference` noise. Each cell gives the
share of presses with a flag other than `stress`, and the share that is wrong by more than four reported standard
deviations without such a flag. The benchmark takes about two minutes.
"""

import sys
from pathlib import Path

from shared import arguments, print_shares

sys.path.insert(0, str(Path(__file__).parents[1]))

from press_faults import fault_shares, film_map, film_variants

RELEASED = "three-25um-biaxial,four-25um-biaxial,four-25um-uniaxial"


def main() -> None:
    requested = arguments(__doc__, models=RELEASED, presses=4000, seed=1)
    models = requested.models.split(",")
    nominal = film_map()
    variants = film_variants()
    inside = {model: fault_shares(model, nominal, variants, requested.presses, requested.seed) for model in models}
    print_shares("flags", requested, "fault", inside)


if __name__ == "__main__":
    main()
