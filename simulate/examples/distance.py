"""
How does the charge depend on the distance?
===========================================

An electrode collects more charge if the press is nearer to the electrode. At every distance, the charge is proportional
to the force to the power of 2/3, like the stress of a membrane without pretension. The curves for all forces therefore
coincide after they are divided by the curve for 1 N and by the force to the power of 2/3.
"""

import matplotlib.pyplot as plt
import numpy as np

from isocharge.simulate import Circle, ForwardMap, load_sensor

sensor = load_sensor("three-25um-biaxial")
forward_map = ForwardMap.build(sensor, Circle(1.0), radius=9.0, force_range=(0.1, 2.0))
y = np.linspace(-9.0, 9.0, 181)  # the centre of electrode A lies at (0, -10) mm

figure, (charges, ratios) = plt.subplots(1, 2, figsize=(11.0, 4.4), layout="constrained", sharex=True)
at_1_N = forward_map.charges(np.column_stack([0.0 * y, y, np.ones_like(y)]))[:, 0]
for force in (0.1, 0.5, 1.0, 2.0):
    charge = forward_map.charges(np.column_stack([0.0 * y, y, np.full_like(y, force)]))[:, 0]
    scaled = charge / at_1_N / force ** (2.0 / 3.0)
    print(
        f"{force:g} N: {charge.max():5.0f} to {charge.min():4.0f} pC, "
        f"divided by the charge at 1 N and by F^(2/3): {scaled.min():.3f} to {scaled.max():.3f}"
    )
    charges.plot(y + 10.0, charge, label=f"{force:g} N")
    ratios.plot(y + 10.0, scaled, label=f"{force:g} N")
charges.set(xlabel="distance from the centre of A, mm", ylabel="charge of A, pC")
ratios.set(xlabel="distance from the centre of A, mm", ylabel="charge / (charge at 1 N * F^(2/3))")
charges.legend()
plt.show()
