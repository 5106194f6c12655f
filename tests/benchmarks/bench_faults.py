"""Which faulty presses the released models flag, and which they answer wrongly: the tables of serve/docs/unnoticed.md.

    python tests/benchmarks/bench_faults.py [--models NAME,...] [--presses 4000] [--whole-film] [--seed 1]

Presses of a circle of 1 mm over the whole range of forces, 0.05 to 2 N, inside the working area, with `reference`
noise. Each cell gives the share of presses with a flag other than `stress`, and the share that is wrong by more than
four reported standard deviations without such a flag. The benchmark takes about two minutes.

With `--whole-film`, the presses have no fault, 0.2 to 2 N, and lie up to 43 mm from the centre of a film with a radius
of 45 mm. The third share is that of presses whose charges a press inside the working area also has, so that no method
can notice them. The charges come from a coarse forward map (within 5 % near the clamp, 0.5 % elsewhere).
"""

import sys
from pathlib import Path

from shared import arguments, print_results

sys.path.insert(0, str(Path(__file__).parents[1]))

from press_faults import Shares, fault_shares, film_map, film_variants, whole_film_shares

RELEASED = "three-25um-biaxial,four-25um-biaxial,four-25um-uniaxial"
RING_EDGES_mm = (8.0, 10.0, 12.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 43.0)


def cell(shares: Shares | None) -> str:
    """Return a cell of a table: shares in percent, with a decimal where they are below one percent."""
    if shares is None:
        return "-"
    return ", ".join(f"{share:.1f}" if share < 1.0 else f"{share:.0f}" for share in vars(shares).values())


def main() -> None:
    asked = arguments(__doc__, models=RELEASED, presses=4000, whole_film=False, seed=1)
    models = asked.models.split(",")
    if asked.whole_film:
        columns = [whole_film_shares(model, asked.presses, asked.seed, RING_EDGES_mm) for model in models]
    else:
        films = film_map(), film_variants()
        columns = [fault_shares(model, *films, asked.presses, asked.seed) for model in models]
    rows = max(columns, key=len)
    table = {row: " | ".join(cell(column.get(row)) for column in columns) for row in rows}
    print_results("faults", asked, {" | ".join(models): table})


if __name__ == "__main__":
    main()
