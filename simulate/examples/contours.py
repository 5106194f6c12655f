"""
Where do presses give an electrode the same charge?
===================================================

All presses of one force that give an electrode the same charge lie on an isocharge contour. If the force of a press is
known, the charge of each electrode determines one contour. The contours of three electrodes meet at the position of the
press.
"""

import matplotlib.pyplot as plt
import numpy as np

from isocharge.simulate import ChargeSpline, Circle, ForwardMap, Triangulation, load_sensor
from isocharge.simulate.plots.figure import COLOURS
from isocharge.simulate.plots.film import draw_electrodes, frame_film

sensor = load_sensor("three-25um-biaxial")
force = 0.7
charge_map = ChargeSpline.of(ForwardMap.build(sensor, Circle(1.0), radius=9.0, force_range=(force, force)))
touch = np.array([[2.0, -3.0, force]])
charge = charge_map.charges(touch)
fix = Triangulation(charge_map).locate(charge)
print(f"position of the press: {touch[0, :2]} mm; the contours meet at {fix.contact[0, :2].round(4)} mm")

figure, axes = plt.subplots(figsize=(6.0, 6.0), layout="constrained")
x, y = np.meshgrid(np.linspace(-6.3, 6.3, 101), np.linspace(-6.3, 6.3, 101))  # within the radius of the map
grid_charges = charge_map.charges(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, force)]))
for number, name in enumerate(sensor.electrode_names):
    axes.contour(x, y, grid_charges[:, number].reshape(x.shape), [charge[0, number]], colors=COLOURS[number])
    axes.plot([], [], color=COLOURS[number], label=f"{charge[0, number]:.0f} pC on {name}")
draw_electrodes(axes, sensor)
axes.plot(*touch[0, :2], "k+", ms=12, label="the press")
axes.legend()
frame_film(axes, sensor, 6.3, f"presses of {force:g} N")
plt.show()
