"""
How do I switch a lamp by touch?
================================

This example switches a lamp with each hard press. Its loop receives one record for each frame of a board.
``python serve/examples/lamp.py /dev/ttyACM0`` reads the board at this port for twenty seconds. Without a port, the
example uses a simulated sensor.
"""

import sys
from contextlib import nullcontext

import matplotlib.pyplot as plt

from isocharge.serve import Chunk, Port, Predictor, VirtualSensor, stream, wander
from isocharge.simulate import Circle, ForwardMap, load_sensor, noise_model

RATE_HZ = 200.0
SECONDS = 20.0
HARD_PRESS_N = 0.5


def simulated_chunks():
    """Yield the bytes of each frame of a simulated board, without waiting for the time of the frame."""
    forward_map = ForwardMap.build(load_sensor("three-25um-biaxial"), Circle(1.0))
    script = wander(seed=2, rate_Hz=RATE_HZ)
    sensor = VirtualSensor(forward_map.charges, script, noise=noise_model("reference").add)
    for number, data in enumerate(sensor.frames()):
        yield Chunk(data, number / RATE_HZ, 0)


port = Port(sys.argv[1], wait=60.0) if len(sys.argv) > 1 else nullcontext(simulated_chunks())
times_s = []
forces_N = []
lamp_states = []
is_on = False
has_switched = False  # whether the present touch has already switched the lamp
with port as chunks:
    for record in stream(chunks, Predictor("three-25um-biaxial")):  # the tare is measured in the first half second
        # The flag `stress` means that the press leaves a dent in the film. The contact itself is correct.
        is_reliable = record.contact and not set(record.flags) - {"stress"}
        is_hard_press = is_reliable and record.force_N > HARD_PRESS_N
        if is_hard_press and not has_switched:
            is_on = not is_on  # a real program would switch its lamp here
            state = "on" if is_on else "off"
            print(f"{state} by {record.force_N:.2f} N at ({record.x_mm:.1f}, {record.y_mm:.1f}) mm")
        is_released = record.force_N == 0.0  # the force of an invalid frame is None, so the touch goes on
        has_switched = not is_released and (has_switched or is_hard_press)
        times_s.append(record.timestamp)
        forces_N.append(record.force_N or 0.0)
        lamp_states.append(is_on)
        if times_s[-1] - times_s[0] > SECONDS:
            break

figure, axes = plt.subplots(figsize=(9.0, 3.6), layout="constrained")
lamp_heights = [2.0 * is_on for is_on in lamp_states]
axes.fill_between(times_s, 0.0, lamp_heights, color="gold", alpha=0.4, step="post", label="the lamp")
axes.plot(times_s, forces_N, label="force")
axes.axhline(HARD_PRESS_N, color="k", ls=":", lw=0.8)
axes.set(xlabel="time, s", ylabel="force, N")
axes.legend(loc="upper right")
plt.show()
