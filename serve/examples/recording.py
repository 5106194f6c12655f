"""
How do I look at a recording?
=============================

``isocharge serve stream --record`` keeps bytes and records, and ``isocharge serve plot`` draws them. In Python a
recording gives its records as they were written, each as a structure of the fields that are wanted.
"""

import tempfile
from itertools import islice
from pathlib import Path

import matplotlib.pyplot as plt
from msgspec import Struct

from isocharge.serve import Chunk, Predictor, Recorder, Recording, TouchStream, VirtualSensor, wander
from isocharge.simulate import Circle, ForwardMap, load_sensor, noise_model
from isocharge.simulate.plots.film import draw_electrodes, frame_film


class Touch(Struct):
    """What is wanted of a record; where nothing touches, there is no place."""

    contact: bool
    x_mm: float | None
    y_mm: float | None
    force_N: float | None


sensor, touch = load_sensor("three-25um-biaxial"), TouchStream(Predictor("three-25um-biaxial"))
film = ForwardMap.build(sensor, Circle(1.0))
board = VirtualSensor(film.charges, wander(seed=2), noise=noise_model("reference").add)
with tempfile.TemporaryDirectory() as folder:
    path = Path(folder) / "touch.rec"
    with Recorder(path, "three-25um-biaxial/1", "every", {}) as recorder:
        for number, data in enumerate(islice(board.frames(), 4000)):
            chunk = Chunk(data, number / 200.0, 0)
            recorder.chunk(chunk, [record.to_json() for record in touch.feed(chunk)])
    records = list(Recording(path).records(Touch))
touches = [record for record in records if record.contact]
print(f"{len(records)} records, {len(touches)} of them of touches, up to {max(t.force_N for t in touches):.2f} N")

figure, axes = plt.subplots(figsize=(6.4, 5.6), layout="constrained")
x, y, force = zip(*((t.x_mm, t.y_mm, t.force_N) for t in touches), strict=True)
shades = axes.scatter(x, y, c=force, s=4, cmap="viridis")
figure.colorbar(shades, label="force, N")
draw_electrodes(axes, sensor)
frame_film(axes, sensor, 8.0, "twenty seconds of touches")
plt.show()
