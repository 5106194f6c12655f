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

# The piezoelectric coefficients do not change the stress, so both sensors use the same solved presses.
biaxial_map = ForwardMap.build(
    load_sensor("three-25um-biaxial"), Polygon.triangle(4.0), radius=12.0, force_range=(0.9, 1.1)
)

# Presses of 1 N at three distances from the centre of A, in seven directions
angles = np.array([35.0, 45.0, 55.0, 65.0, 75.0, 85.0, 90.0])  # degrees from x
distances = np.array([4.0, 8.0, 12.0])  # mm
angle, distance = np.meshgrid(np.deg2rad(angles), distances, indexing="ij")
x_of_a, y_of_a = biaxial_map.sensor.electrodes[0].centre
x = x_of_a + distance * np.cos(angle)
y = y_of_a + distance * np.sin(angle)
presses = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])

figure, pair = plt.subplots(1, 2, figsize=(11.0, 4.4), layout="constrained", sharey=True)
for axes, kind in zip(pair, ("biaxial", "uniaxial"), strict=True):
    sensor = load_sensor(f"three-25um-{kind}")
    forward_map = replace(biaxial_map, sensor=sensor)
    charge_of_a = forward_map.charges(presses)[:, 0].reshape(len(angles), len(distances))
    # Difference between the directions at each distance, relative to the mean charge at this distance
    difference = np.ptp(charge_of_a, axis=0) / charge_of_a.mean(axis=0)
    print(
        f"{kind}: the charges of different directions differ by {100 * difference.min():.0f} to "
        f"{100 * difference.max():.0f} % of their mean"
    )
    for angle, charge in zip(angles, charge_of_a, strict=True):
        axes.plot(distances, charge, "o-", label=f"{angle:.0f}°")
    axes.set(title=f"{kind} film, triangle, 1 N", xlabel="distance from the centre of A, mm")
pair[0].set_ylabel("charge of A, pC")
pair[1].legend(title="direction from x")
plt.show()
