"""Presses anywhere on the film: which of them a released model answers wrongly without a flag, by distance.

    python tests/benchmarks/bench_whole_film.py [--models NAME,...] [--presses 2000] [--seed 1] [--json]

Presses of a circle of 1 mm with 0.2 to 2 N and `reference` noise, up to 43 mm from the centre of a film with a radius
of 45 mm. Each cell gives three shares: presses with a flag other than `stress`; presses that are wrong by more than
four reported standard deviations without such a flag; and presses whose charges a press inside the working area also
has, so that no method can notice them. The charges come from a coarse forward map (within 5 % near the clamp, 0.5 %
elsewhere).
"""

import sys
from pathlib import Path

from shared import arguments, print_shares

sys.path.insert(0, str(Path(__file__).parents[1]))

from press_faults import whole_film_shares

RELEASED = (
    "three-25um-biaxial,four-25um-biaxial,four-25um-uniaxial,four-25um-biaxial-15mm,three-25um-biaxial-12mm,"
    "eight-25um-biaxial,six-25um-biaxial-30mm,eight-25um-biaxial-36mm"
)
RING_EDGES_mm = (8.0, 10.0, 12.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 43.0)


def main() -> None:
    requested = arguments(__doc__, models=RELEASED, presses=2000, seed=1)
    models = requested.models.split(",")
    results = {model: whole_film_shares(model, requested.presses, requested.seed, RING_EDGES_mm) for model in models}
    print_shares("whole film", requested, "distance", results, empty="-")


if __name__ == "__main__":
    main()
