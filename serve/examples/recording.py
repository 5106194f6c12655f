"""
How do I look at a recording?
=============================

A recording is a file with the bytes of a board and the records that were computed from them. The command ``isocharge
serve stream --record FILE`` writes a recording, and ``isocharge serve plot FILE`` draws it. This example writes a
recording and reads its records in Python. The class ``Touch`` declares which fields of the records are read.
"""

import tempfile
from itertools import islice
from pathlib import Path

import matplotlib.pyplot as plt
from msgspec import Struct

from isocharge.serve import Chunk, Predictor, Recorder, Recording, TouchStream, VirtualSensor, wander
from isocharge.simulate import Circle, ForwardMap, load_sensor, noise_model
from isocharge.simulate.plots.film import draw_electrodes, frame_film

RATE_HZ = 200.0
FRAMES = 4000


class Touch(Struct):
    """Fields that are read from each record. The position is None if nothing touches the film."""

    contact: bool
    x_mm: float | None
    y_mm: float | None
    force_N: float | None


sensor = load_sensor("three-25um-biaxial")
touch = TouchStream(Predictor("three-25um-biaxial"))
forward_map = ForwardMap.build(sensor, Circle(1.0))
board = VirtualSensor(forward_map.charges, wander(seed=2), noise=noise_model("reference").add)
with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "touch.rec"
    with Recorder(path, "three-25um-biaxial/1", {}) as recorder:
        for number, data in enumerate(islice(board.frames(), FRAMES)):
            chunk = Chunk(data, number / RATE_HZ, 0)
            recorder.event(chunk=chunk)
            for record in touch.feed(chunk):
                recorder.write(record.to_json())
    records = list(Recording(path).records(Touch))

touches = [record for record in records if record.contact]
x_mm = [record.x_mm for record in touches]
y_mm = [record.y_mm for record in touches]
force_N = [record.force_N for record in touches]
print(f"{len(records)} records, {len(touches)} of them of touches, up to {max(force_N):.2f} N")

figure, axes = plt.subplots(figsize=(6.4, 5.6), layout="constrained")
dots = axes.scatter(x_mm, y_mm, c=force_N, s=4, cmap="viridis")
figure.colorbar(dots, label="force, N")
draw_electrodes(axes, sensor)
frame_film(axes, sensor, 8.0, "twenty seconds of touches")
plt.show()
