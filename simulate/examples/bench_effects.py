"""
Which errors do effects of the bench cause?
===========================================

Trapped air, a warm film, static pressure and a side force change the position and the force of a contact.

The charges are computed with the effect. The contact is then estimated from the charges by a linear inverse of the film
without the effect.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from isocharge.simulate import Circle, Resolution, Sensor, SolveSettings, load_sensor, noise_model, press, touch_charge
from isocharge.simulate.mechanics.warming import warmed

CONTACTS = ((3.0, -2.0, 0.5), (-5.0, 4.0, 0.1), (5.5, 4.5, 0.5))  # x and y in mm, force in N
# All presses have the same mesh, so that the errors of the mesh cancel in the differences of charges.
SAME_MESH = SolveSettings(resolution=Resolution(order=6, around=8, rings=7, rim=2))
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


def charges(sensor: Sensor, x: float, y: float, force: float, relative_side_force: float = 0.0) -> np.ndarray:
    """Compute the charges of a press with a side force along x.

    Args:
        sensor: The sensor.
        x: Position along x, mm.
        y: Position along y, mm.
        force: Force of the press, N.
        relative_side_force: Ratio of the side force to the force of the press.

    Returns:
        Charges, shape (n_electrode,), pC.
    """
    side_force = (relative_side_force * force, 0.0)
    return touch_charge(sensor, press(sensor.film, Circle(1.0), (x, y), force, SAME_MESH, side_force=side_force))


figure, axes = plt.subplots(figsize=(8.0, 4.0), layout="constrained")
for number, (x, y, force) in enumerate(CONTACTS):
    # Derivatives of the charges with respect to x, y and ln F, by central differences
    expected = charges(sensor, x, y, force)
    derivatives = []
    for x_step, y_step, log_force_step in STEPS:
        above = charges(sensor, x + x_step, y + y_step, force * np.exp(log_force_step))
        below = charges(sensor, x - x_step, y - y_step, force * np.exp(-log_force_step))
        step = x_step + y_step + log_force_step  # only one of them is not zero
        derivatives.append((above - below) / (2.0 * step))

    # Weighted least squares converts a change of the charges into a change of the contact.
    sigma = noise_model("reference").sigma(expected)
    inverse = np.linalg.pinv(np.column_stack(derivatives) / sigma[:, None])
    position_errors = []
    for name, (changed_sensor, relative_side_force) in effects.items():
        changed = charges(changed_sensor, x, y, force, relative_side_force)
        x_error, y_error, log_force_error = inverse @ ((changed - expected) / sigma)
        position_error = np.hypot(x_error, y_error)
        position_errors.append(position_error)
        print(
            f"{force:.1f} N at ({x:g}, {y:g}) mm, {name}: {position_error:.2f} mm, "
            f"{100.0 * log_force_error:+.1f} % of the force"
        )
    axes.barh(np.arange(len(effects)) + 0.27 * number, position_errors, 0.25, label=f"{force:g} N at ({x:g}, {y:g}) mm")

axes.set_yticks(np.arange(len(effects)) + 0.27, list(effects))
axes.invert_yaxis()
axes.set_xscale("log")
axes.set_xlabel("error of the position, mm")
axes.set_title("Effects of the bench that the model omits, at a pretension of 0.8 MPa")
axes.legend()
plt.show()
