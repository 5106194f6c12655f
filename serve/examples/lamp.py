"""
How do I switch a lamp by touch?
================================

Each frame of a board becomes a record: act on it. ``python serve/examples/lamp.py /dev/ttyACM0`` follows a board at a
port for twenty seconds; without a port, a simulated sensor plays.
"""

import sys

import matplotlib.pyplot as plt

from isocharge.serve import Chunk, Port, Predictor, VirtualSensor, stream, wander
from isocharge.simulate import Circle, ForwardMap, load_sensor, noise_model

RATE_HZ, SECONDS, HARD_N = 200.0, 20.0, 0.5


def simulated():
    """What a board sends in each of its frames, without waiting for it."""
    film = ForwardMap.build(load_sensor("three-25um-biaxial"), Circle(1.0))
    sensor = VirtualSensor(film.charges, wander(seed=4, rate_Hz=RATE_HZ), noise=noise_model("reference").add)
    return (Chunk(data, number / RATE_HZ, 0) for number, data in enumerate(sensor.frames()))


chunks = Port(sys.argv[1], wait=60.0) if len(sys.argv) > 1 else simulated()
time, force, lamp, on, touched = [], [], [], False, False
for record in stream(chunks, Predictor("three-25um-biaxial")):  # the first half second is the tare
    trusted = record.contact and not set(record.flags) - {"stress"}  # that flag says that the film will have a dent
    pressed = trusted and record.force_N > HARD_N
    if pressed and not touched:
        on = not on  # here a program would switch its lamp
        print(f"{'on' if on else 'off'} by {record.force_N:.2f} N at ({record.x_mm:.1f}, {record.y_mm:.1f}) mm")
    touched = record.contact and (touched or pressed)
    time.append(record.timestamp)
    force.append(record.force_N or 0.0)
    lamp.append(on)
    if time[-1] - time[0] > SECONDS:
        break

figure, axes = plt.subplots(figsize=(9.0, 3.6), layout="constrained")
axes.fill_between(time, 0.0, [2.0 * value for value in lamp], color="gold", alpha=0.4, step="post", label="the lamp")
axes.plot(time, force, label="force")
axes.axhline(HARD_N, color="k", ls=":", lw=0.8)
axes.set(xlabel="time, s", ylabel="force, N")
axes.legend(loc="upper right")
plt.show()
