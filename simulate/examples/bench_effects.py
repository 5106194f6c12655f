"""Errors of a contact by effects of the bench: trapped air, a warm film, static pressure, and a side force.

The charges with the effect are interpreted by a linear inverse of the film without it.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from isocharge.simulate import Circle, Sensor, SolveSettings, load_sensor, noise_model, press, touch_charge
from isocharge.simulate.mechanics.film_temperature import warmed

CONTACTS = ((3.0, -2.0, 0.5), (-5.0, 4.0, 0.1), (5.5, 4.5, 0.5))  # x and y in mm, force in N
STEPS = ((0.05, 0.0, 0.0), (0.0, 0.05, 0.0), (0.0, 0.0, 0.01))  # in x and y, mm, and in the logarithm of the force

sensor = load_sensor("four-25um-biaxial")
sensor = replace(sensor, film=replace(sensor.film, pretension=0.8, expansion=(1e-4, 1e-4)))
closed = replace(sensor, film=replace(sensor.film, back_volume=20.0 * np.pi * sensor.film.radius**2))
pressed = replace(sensor, film=replace(sensor.film, static_pressure=1e-6))
effects = {
    "closed cavity of 20 mm": (closed, 0.0),
    "film 1 K warmer than its ring": (warmed(sensor, 1.0), 0.0),
    "static pressure of 1 Pa": (pressed, 0.0),
    "side force of 0.2 F along x": (sensor, 0.2),
}


def charges(sensor: Sensor, x: float, y: float, force: float, side_share: float = 0.0) -> np.ndarray:
    """Compute the charges of a press with a side force along x."""
    side_force = (side_share * force, 0.0)
    settings = SolveSettings(accuracy=1e-4)
    return touch_charge(sensor, press(sensor.film, Circle(1.0), (x, y), force, settings, side_force=side_force))


figure, axes = plt.subplots(figsize=(8.0, 4.0), layout="constrained")
for number, (x, y, force) in enumerate(CONTACTS):
    position_errors = []
    expected = charges(sensor, x, y, force)
    columns = []
    for dx, dy, dlog in STEPS:
        above = charges(sensor, x + dx, y + dy, force * np.exp(dlog))
        below = charges(sensor, x - dx, y - dy, force * np.exp(-dlog))
        columns.append((above - below) / (2.0 * (dx + dy + dlog)))
    sigma = noise_model("reference").sigma(expected)
    inverse = np.linalg.pinv(np.column_stack(columns) / sigma[:, None])
    for name, (changed, side_share) in effects.items():
        error_x, error_y, error_log = inverse @ ((charges(changed, x, y, force, side_share) - expected) / sigma)
        position_errors.append(np.hypot(error_x, error_y))
        print(
            f"{force:.1f} N at ({x:g}, {y:g}) mm, {name}: {np.hypot(error_x, error_y):.2f} mm, "
            f"{100.0 * error_log:+.1f} % of the force"
        )
    axes.barh(np.arange(len(effects)) + 0.27 * number, position_errors, 0.25, label=f"{force:g} N at ({x:g}, {y:g}) mm")

axes.set_yticks(np.arange(len(effects)) + 0.27, list(effects))
axes.invert_yaxis()
axes.set_xscale("log")
axes.set_xlabel("error of the position, mm")
axes.set_title("Effects of the bench that the model does not contain, at 0.8 MPa")
axes.legend()
plt.show()
