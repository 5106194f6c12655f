"""
Where should electrodes go?
===========================

At the best positions of the electrodes, the largest position error in the working area is smallest. This example
searches for the best positions of three squares for presses within 8 mm. The search starts from 24 random layouts. The
largest error is 0.24 mm with three squares on a circle, and 0.13 mm with the positions that the search found. The film
and the probe are assumed to be known exactly.
"""

import matplotlib.pyplot as plt

from isocharge.simulate import DesignCase, design, load_sensor
from isocharge.simulate.layout.case import NO_NUISANCES
from isocharge.simulate.plots.film import draw_layout

result = design(DesignCase(load_sensor("three-25um-biaxial"), electrodes=3, radius=8.0, nuisances=NO_NUISANCES))
figure, pair = plt.subplots(1, 2, figsize=(11.0, 5.4), layout="compressed", sharex=True, sharey=True)
layouts = ((result.case.sensor, result.errors_before), (result.sensor, result.errors_after))
largest = layouts[0][1].noise_alone.max()
for axes, (sensor, errors) in zip(pair, layouts, strict=True):
    worst = errors.noise_alone.max()
    print(f"{sensor.name}: largest position error {worst:.3f} mm")
    shades = axes.tripcolor(*errors.presses.T, errors.noise_alone, shading="gouraud", vmin=0.0, vmax=largest)
    draw_layout(axes, sensor, result.case.radius, f"{sensor.name}\nlargest error {worst:.3f} mm")
figure.colorbar(shades, ax=list(pair), label="lower limit of the position error (rms), mm")
plt.show()
