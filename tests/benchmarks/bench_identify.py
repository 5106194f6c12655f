"""What the built-in sensors' charges can tell: the table and the picture of simulate/docs/identifiability.md.

    python tests/benchmarks/bench_identify.py [-o simulate/pictures/identify.png]

One family of presses serves all four: layouts and coefficients only read it differently.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from isocharge.common.files import write_whole
from isocharge.simulate import Circle, ForwardMap, load_sensor, noise_model
from isocharge.simulate.identifiability.identification import Identification, search_radius
from isocharge.simulate.plots.figure import new_figure
from isocharge.simulate.plots.limit_map import TICKS, draw_limit_map

SENSORS = ("three-25um-biaxial", "three-25um-uniaxial", "four-25um-biaxial", "four-25um-uniaxial")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, help="PNG to write")
    output = parser.parse_args().output
    probe = Circle(1.0)
    widest = max((load_sensor(name) for name in SENSORS), key=lambda sensor: search_radius(sensor, probe))
    film = ForwardMap.build(widest, probe, search_radius(widest, probe))
    figure = new_figure(11.5, 10.4)
    all_axes = figure.subplots(2, 2)
    print("| sensor | working area | first fold | position, 0.05 N, 1 N | force, 0.05 N, 1 N |\n|---|---|---|---|---|")
    for name, axes in zip(SENSORS, all_axes.ravel(), strict=True):
        identified = Identification.of(replace(film, sensor=load_sensor(name)), noise_model("reference"))
        weak, one, _ = (limits.statistics() for limits in identified.inside)
        print(
            f"| {name} | {identified.area.radius:.1f} mm | {identified.area.fold_radius:.1f} mm | "
            f"{weak['position_median_mm']:.3f}, {one['position_median_mm']:.3f} mm | "
            f"{weak['force_median_percent']:.2f}, {one['force_median_percent']:.2f} % |"
        )
        shades = draw_limit_map(axes, identified, identified.maps[1])
        axes.set_title(f"{name}: {axes.get_title()}", fontsize=10)
    if output:
        figure.colorbar(
            shades, ax=all_axes, label="least position error (rms), mm", ticks=TICKS, format="%g", shrink=0.7
        )
        draft = output.with_suffix(".new.png")
        figure.savefig(draft, dpi=80)
        write_whole(output, draft.read_bytes())
        draft.unlink()


if __name__ == "__main__":
    main()
