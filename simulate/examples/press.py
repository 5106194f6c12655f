"""
What does a press do to the film?
=================================

A press of 1 N by a circular probe of 1 mm radius deflects a film of 25 um by almost 3 mm. The press stretches the film.
The resulting stress polarises the film, and each electrode collects a charge.
"""

import matplotlib.pyplot as plt

from isocharge.simulate import Circle, load_sensor, press, touch_charge
from isocharge.simulate.plots.film import draw_deflection, draw_electrodes, draw_section

sensor = load_sensor("three-25um-biaxial")
equilibrium = press(sensor.film, Circle(1.0), at=(3.0, -2.0), force=1.0)  # mm, N
for name, charge in zip(sensor.electrode_names, touch_charge(sensor, equilibrium), strict=True):
    print(f"{name} collects {charge:.0f} pC")

figure, (film, cut) = plt.subplots(1, 2, figsize=(11.0, 4.6), layout="constrained")
draw_deflection(film, equilibrium)
draw_electrodes(film, sensor, names=False)
draw_section(cut, equilibrium)
plt.show()
