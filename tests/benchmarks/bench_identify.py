"""What the built-in sensors' charges can tell: the table and the picture of simulate/docs/identifiability.md.

    python tests/benchmarks/bench_identify.py -o simulate/pictures/identify.png

One family of presses serves all four: layouts and coefficients only read it differently.
"""

import argparse
from dataclasses import replace
from pathlib import Path

from isocharge.simulate import Circle, ForwardMap, load_sensor, noise_model
from isocharge.simulate.identifiability.identification import Identification, search_radius
from isocharge.simulate.plots.error_maps import TICKS, draw_limit_map
from isocharge.simulate.plots.figure import new_figure

SENSORS = ("three-25um-biaxial", "three-25um-uniaxial", "four-25um-biaxial", "four-25um-uniaxial")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("-o", "--output", type=Path, required=True, help="PNG to write")
    output, sensors = parser.parse_args().output, [load_sensor(name) for name in SENSORS]
    film = ForwardMap.build(sensors[0], Circle(1.0), max(search_radius(sensor, Circle(1.0)) for sensor in sensors))
    figure = new_figure(11.5, 10.4)
    every = figure.subplots(2, 2)
    print("| sensor | working area | first fold | position, 0.05 N, 1 N | force, 0.05 N, 1 N |\n|---|---|---|---|---|")
    for sensor, axes in zip(sensors, every.ravel(), strict=True):
        identified = Identification.of(replace(film, sensor=sensor), noise_model("reference"))
        weak, one, _ = (limits.statistics() for limits in identified.inside)
        print(
            f"| {sensor.name} | {identified.area.radius:.1f} mm | {identified.area.fold_radius:.1f} mm | "
            f"{weak['position_median_mm']:.3f}, {one['position_median_mm']:.3f} mm | "
            f"{weak['force_median_percent']:.2f}, {one['force_median_percent']:.2f} % |"
        )
        shades = draw_limit_map(axes, identified, identified.maps[1])
        axes.set_title(f"{sensor.name}: {axes.get_title()}", fontsize=10)
    figure.colorbar(shades, ax=every, label="least position error (rms), mm", ticks=TICKS, format="%g", shrink=0.7)
    figure.savefig(output, dpi=80)


if __name__ == "__main__":
    main()
