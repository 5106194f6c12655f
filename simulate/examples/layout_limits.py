"""
How accurate can a layout be?
=============================

The Cramer-Rao limit is the smallest position error that any unbiased method can have. This example computes the limit
for presses of 1 N on a film with four squares of 3 mm, 9 mm from the centre. The limit is 0.03 mm in the middle of the
film. It is largest 8 mm from the centre, between two squares, where it is 0.18 mm.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from isocharge.simulate import (
    ChargeSpline,
    Circle,
    Electrode,
    ForwardMap,
    limits_at,
    load_sensor,
    noise_model,
    working_area,
)
from isocharge.simulate.plots.film import draw_electrodes, draw_working_area, frame_film

centres = {"A": (9.0, 0.0), "B": (0.0, 9.0), "C": (-9.0, 0.0), "D": (0.0, -9.0)}
squares = tuple(Electrode.of_square(name, centre, 3.0) for name, centre in centres.items())
sensor = replace(load_sensor("four-25um-biaxial"), name="mine", electrodes=squares)
noise = noise_model("reference")
charge_map = ChargeSpline.of(ForwardMap.build(sensor, Circle(1.0), radius=8.0, force_range=(0.05, 2.0)))

distance, angle = np.meshgrid(np.linspace(0.0, 8.0, 17), np.linspace(0.0, 2.0 * np.pi, 73))
x = (distance * np.cos(angle)).ravel()
y = (distance * np.sin(angle)).ravel()
limits = limits_at(charge_map, np.column_stack([x, y, np.ones_like(x)]), noise)
for at, position, relative in zip(distance[0, ::2], limits.position[:17:2], limits.force[:17:2], strict=True):
    print(f"{at:.0f} mm from the centre, 1 N: limits {position:.3f} mm, {100 * relative:.2f} % of the force")
area = working_area(charge_map, noise, search_pairs=False)
print(area.summary)

figure, axes = plt.subplots(figsize=(6.6, 5.6), layout="constrained")
shades = axes.tricontourf(x, y, limits.position, levels=20)
figure.colorbar(shades, label="lower limit of the position error at 1 N (rms), mm")
draw_electrodes(axes, sensor)
draw_working_area(axes, area.radius)
frame_film(axes, sensor, 8.0, "four squares, 9 mm from the centre")
plt.show()
