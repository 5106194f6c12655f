"""Which faults of presses inside the working area the released models flag: a table of serve/docs/unnoticed.md.

    python tests/benchmarks/bench_flags.py [--models NAME,...] [--presses 4000] [--seed 1] [--json]

Presses of a circle of 1 mm over the whole range of forces, 0.05 to 2 N, with `reference` noise. Each cell gives the
share of presses with a flag other than `stress`, and the share that is wrong by more than four reported standard
deviations without such a flag. The benchmark takes about two minutes.
"""

import sys
from dataclasses import asdict
from pathlib import Path

from shared import arguments, markdown_table, print_results

sys.path.insert(0, str(Path(__file__).parents[1]))

from press_faults import FaultStudy, Shares, film_map, film_variants

RELEASED = "three-25um-biaxial,four-25um-biaxial,four-25um-uniaxial"


def cell(shares: Shares | None) -> str:
    """Return the two shares of a cell as text, in %; empty if the model has no such fault."""
    if shares is None:
        return ""
    return f"{percent(shares.flagged)}, {percent(shares.unnoticed)}"


def percent(share: float) -> str:
    """Return a share in percent as text, with a decimal where it is below one percent."""
    return f"{share:.1f}" if share < 1.0 else f"{share:.0f}"


def main() -> None:
    requested = arguments(__doc__, models=RELEASED, presses=4000, seed=1, json=False)
    models = requested.models.split(",")
    nominal = film_map()
    variants = film_variants()
    inside = {
        model: FaultStudy(model, nominal, variants, requested.presses, requested.seed).results() for model in models
    }
    if requested.json:
        results = {model: {fault: asdict(shares) for fault, shares in rows.items()} for model, rows in inside.items()}
        print_results("flags", requested, results)
        return
    print_results("flags", requested, {"inside the working area": markdown_table("fault", inside, cell)})


if __name__ == "__main__":
    main()
