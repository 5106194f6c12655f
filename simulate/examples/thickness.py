"""
How do thickness and pretension change the charges?
===================================================

Under the same force, the stress in a thicker film is smaller, and a film with pretension deflects less. In both cases,
the electrodes collect smaller charges.
"""

from dataclasses import replace

import matplotlib.pyplot as plt

from isocharge.simulate import Circle, load_sensor, press, touch_charge

sensor = load_sensor("three-25um-biaxial")
pretensions = (0.0, 0.5, 1.0, 2.0, 4.0)
print("thickness, mm   pretension, MPa   charge of A, pC")
for thickness in (0.025, 0.05, 0.11):
    charges = []
    for pretension in pretensions:
        film = replace(sensor.film, thickness=thickness, pretension=pretension)
        equilibrium = press(film, Circle(1.0), at=(3.0, -2.0), force=1.0)
        charges.append(touch_charge(replace(sensor, film=film), equilibrium)[0])
        print(f"{thickness:13g}   {pretension:15g}   {charges[-1]:15.1f}")
    plt.plot(pretensions, charges, "o-", label=f"{1000 * thickness:g} um")
plt.gca().set(xlabel="pretension, MPa", ylabel="charge of A under 1 N, pC", ylim=(0, None))
plt.legend()
plt.show()
