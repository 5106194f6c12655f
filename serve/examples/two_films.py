"""
How do I read two films at once?
================================

Each film has its own stream, with its own model, tare and name. In this example, the films are on the thumb and the
index finger of a hand. A pinch is a time in which both films are touched. With two boards, run the stream of each port
in its own thread or process.
"""

from itertools import islice

import matplotlib.pyplot as plt
import numpy as np

from isocharge.serve import Chunk, Predictor, TouchStream, VirtualSensor, wander
from isocharge.simulate import Circle, ForwardMap, load_sensor, noise_model

RATE_HZ = 200.0
FRAMES = 4000
MODELS = {"thumb": "three-25um-biaxial", "index": "four-25um-biaxial"}

forces_N = {}
for seed, (finger, model) in enumerate(MODELS.items()):
    forward_map = ForwardMap.build(load_sensor(model), Circle(1.0))
    script = wander(seed=seed, rate_Hz=RATE_HZ)
    board = VirtualSensor(forward_map.charges, script, noise=noise_model("reference").add, seed=seed)

    touch = TouchStream(Predictor(model), frame_id=finger)
    records = []
    for number, data in enumerate(islice(board.frames(), FRAMES)):
        records += touch.feed(Chunk(data, number / RATE_HZ, 0))
    forces_N[finger] = np.array([record.force_N or 0.0 for record in records])
    touched_share = np.mean(forces_N[finger] > 0.0)
    print(f"{records[0].frame_id}, {records[0].model}: touched in {touched_share:.0%} of the frames")

pinch_N = np.minimum(forces_N["thumb"], forces_N["index"])
print(f"a pinch in {np.mean(pinch_N > 0.0):.0%} of the frames, up to {pinch_N.max():.2f} N")

times_s = np.arange(len(pinch_N)) / RATE_HZ
plt.figure(figsize=(9.0, 3.6), layout="constrained")
for finger, force_N in forces_N.items():
    plt.plot(times_s, force_N, label=finger)
plt.fill_between(times_s, 0.0, pinch_N, alpha=0.5, color="C2", label="pinch")
plt.gca().set(xlabel="time, s", ylabel="force, N")
plt.legend()
plt.show()
