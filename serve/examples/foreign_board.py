"""
What does my board send?
========================

Nobody described these frames: a sync byte, a counter, three channels of 24 bits, a checksum. They are recognised from
their bytes, and the section ``[frames]`` of a device file comes out; ``isocharge serve doctor --port PORT --write
board.toml`` does the same at a port and examines the channels, too.
"""

import matplotlib.pyplot as plt
import numpy as np

from isocharge.serve import device_from_table
from isocharge.serve.recognition.recognise import recognise

rng, frames = np.random.default_rng(1), []
for number in range(400):
    counts = rng.normal((52_000, -31_000, 8_000), 300.0).astype(int)
    body = bytes([0xA5, number % 256]) + b"".join(int(count).to_bytes(3, "big", signed=True) for count in counts)
    frames.append(body + bytes([sum(body[1:]) % 256]))

found = recognise(frames, seconds=2.0)
for key, value in found.items():
    print(f"{key} = {value}")
parser = device_from_table({"frames": found}, "board").parser()
values = np.array([frame.values for data in frames for frame in parser.feed(data)])
print(f"{len(values)} of {len(frames)} frames are read, channels near {np.median(values, axis=0).round(-3)}")

names, at = [], 0
for field in [{"name": "sync", "type": "u8"}, *found["fields"], {"name": found["checksum"], "type": "u8"}]:
    size = int(field["type"][1:]) // 8
    names.append((at + 0.5 * (size - 1), f"{field.get('name', '')}\n{field['type']}"))
    at += size
plt.figure(figsize=(6.4, 4.8), layout="constrained")
plt.imshow(np.frombuffer(b"".join(frames[:60]), np.uint8).reshape(60, -1), aspect="auto", cmap="Blues")
plt.xticks(*zip(*names, strict=True))
plt.gca().set(ylabel="frame", title="60 frames, byte by byte, and what was recognised")
plt.show()
