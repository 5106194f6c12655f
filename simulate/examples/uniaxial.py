"""
Do the charges of a uniaxial film depend more on the direction?
===============================================================

Fig. 12 of the paper (Mirbagheri et al. 2007) shows a stronger dependence on uniaxial films, and the simulator confirms
it. On a biaxial film, the charge of an electrode is nearly the same for presses in different directions at the same
distance. On a uniaxial film, the charges of such presses differ by 50 to 66 % of their mean. The command
``python simulate/examples/paper -o paper`` draws all figures of the paper.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from isocharge.simulate import ForwardMap, Polygon, load_sensor
from isocharge.simulate.contours.charge_curves import Curves, Mapping

# The piezoelectric coefficients do not change the stress, so both sensors use the same solved presses.
biaxial_map = ForwardMap.build(
    load_sensor("three-25um-biaxial"), Polygon.triangle(4.0), radius=12.0, force_range=(0.9, 1.1)
)
figure, pair = plt.subplots(1, 2, figsize=(11.0, 4.4), layout="constrained", sharey=True)
for axes, kind in zip(pair, ("biaxial", "uniaxial"), strict=True):
    sensor = load_sensor(f"three-25um-{kind}")
    forward_map = replace(biaxial_map, sensor=sensor)
    lines = Mapping.lines(sensor, "A", angles=np.deg2rad((35.0, 90.0)), length=12.0)
    curves = Curves.of(forward_map, lines, force=1.0)
    # Difference between the directions at each distance, relative to the mean charge at this distance
    difference = np.ptp(curves.own_charge, axis=0) / curves.own_charge.mean(axis=0)
    print(
        f"{kind}: the charges of different directions differ by {100 * difference.min():.0f} to "
        f"{100 * difference.max():.0f} % of their mean"
    )
    for angle, charge in zip(lines.angle, curves.own_charge, strict=True):
        axes.plot(lines.distance, charge, "o-", label=f"{np.rad2deg(angle):.0f}°")
    axes.set(title=f"{kind} film, triangle, 1 N", xlabel="distance from the centre of A, mm")
pair[0].set_ylabel("charge of A, pC")
pair[1].legend(title="direction from x")
plt.show()
