"""
How do I read two films at once?
================================

One stream for each film, taken in turns: here two fingertips, and a pinch is when both are touched. Each stream has
its own model, tare and name; at two ports each would run in a thread or a process of its own.
"""

from itertools import islice

import matplotlib.pyplot as plt
import numpy as np

from isocharge.serve import Chunk, Predictor, TouchStream, VirtualSensor, wander
from isocharge.simulate import Circle, ForwardMap, load_sensor, noise_model

RATE_HZ, forces = 200.0, []
for seed, (finger, name) in enumerate((("thumb", "three-25um-biaxial"), ("index", "four-25um-biaxial"))):
    film = ForwardMap.build(load_sensor(name), Circle(1.0))
    board = VirtualSensor(
        film.charges, wander(seed=seed, rate_Hz=RATE_HZ), noise=noise_model("reference").add, seed=seed
    )
    touch = TouchStream(Predictor(name), frame_id=finger)
    chunks = (Chunk(data, number / RATE_HZ, 0) for number, data in enumerate(islice(board.frames(), 4000)))
    records = [record for chunk in chunks for record in touch.feed(chunk)]
    forces.append([record.force_N or 0.0 for record in records])
    print(
        f"{records[0].frame_id}, {records[0].model}: touched in {np.mean(np.array(forces[-1]) > 0.0):.0%} of the frames"
    )
thumb, index = np.array(forces)
pinch = np.minimum(thumb, index)
print(f"a pinch in {np.mean(pinch > 0.0):.0%} of the frames, up to {pinch.max():.2f} N")

time = np.arange(len(thumb)) / RATE_HZ
plt.figure(figsize=(9.0, 3.6), layout="constrained")
plt.plot(time, thumb, label="thumb")
plt.plot(time, index, label="index")
plt.fill_between(time, 0.0, pinch, alpha=0.5, color="C2", label="pinch")
plt.gca().set(xlabel="time, s", ylabel="force, N")
plt.legend()
plt.show()
