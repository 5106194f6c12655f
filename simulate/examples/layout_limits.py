"""How well the charges of a layout determine a press: the Cramer-Rao limit on a line, and the working area."""

from dataclasses import replace

import numpy as np

from isocharge.simulate import Circle, Electrode, ForwardMap, limits_at, load_sensor, noise_model, working_area

centres = {"A": (9.0, 0.0), "B": (0.0, 9.0), "C": (-9.0, 0.0), "D": (0.0, -9.0)}
squares = tuple(Electrode.of_square(name, centre, 3.0) for name, centre in centres.items())
sensor = replace(load_sensor("four-25um-biaxial"), name="mine", electrodes=squares)

forward_map, noise = (
    ForwardMap.build(sensor, Circle(1.0), radius=8.0, force_range=(0.05, 2.0)),
    noise_model("reference"),
)
line = np.column_stack([np.linspace(0.0, 7.0, 8), np.zeros(8), np.full(8, 1.0)])  # x, y, F
limits = limits_at(forward_map, line, noise)
for (x, _, force), position, relative in zip(line, limits.position, limits.force, strict=True):
    print(f"{x:.0f} mm from the centre, {force:g} N: at best {position:.3f} mm, {100 * relative:.2f} % of the force")
print(working_area(forward_map, noise, search_pairs=False).summary)
