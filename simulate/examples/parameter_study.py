"""How the charges of a press change with the film's thickness and pretension."""

from dataclasses import replace

from isocharge.simulate import Circle, load_sensor, press, touch_charge

sensor = load_sensor("three-25um-biaxial")
print("thickness, mm   pretension, MPa   charges of A, B, C, pC")
for thickness in (0.025, 0.05, 0.11):
    for pretension in (0.0, 0.5):
        film = replace(sensor.film, thickness=thickness, pretension=pretension)
        equilibrium = press(film, Circle(1.0), at=(3.0, -2.0), force=1.0)
        charge = touch_charge(replace(sensor, film=film), equilibrium)
        print(f"{thickness:13g}   {pretension:15g}   {charge.round(1)}")
