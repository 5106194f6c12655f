"""
What does my board send?
========================

This example recognises the frames of an unknown board from their bytes. Each frame consists of a sync byte, a counter,
three channels of 24 bits, and a checksum. The example prints the section ``[frames]`` of a device file, but writes no
file. To connect a real board, use the command ``isocharge serve doctor --port PORT --write board.toml``. It recognises
the frames at a port, examines the channels, and writes the device file.
"""

import matplotlib.pyplot as plt
import numpy as np

from isocharge.serve import device_from_table
from isocharge.serve.recognition.recognise import recognise

rng = np.random.default_rng(1)
frames = []
for number in range(400):
    counts = rng.normal((52_000, -31_000, 8_000), 300.0).astype(int)
    channels = b"".join(int(count).to_bytes(3, "big", signed=True) for count in counts)
    body = bytes([0xA5, number % 256]) + channels
    checksum = sum(body[1:]) % 256
    frames.append(body + bytes([checksum]))

found = recognise(frames, seconds=2.0)
for key, value in found.items():
    print(f"{key} = {value}")
parser = device_from_table({"frames": found}, "board").parser()
values = np.array([frame.values for data in frames for frame in parser.feed(data)])
print(f"{len(values)} of {len(frames)} frames are read, channels near {np.median(values, axis=0).round(-3)}")

# The picture has one row for each frame. The labels below the bytes are the name and the type of each field.
fields = [{"name": "sync", "type": "u8"}, *found["fields"], {"name": found["checksum"], "type": "u8"}]
tick_positions = []
tick_labels = []
first_byte = 0
for field in fields:
    size = int(field["type"][1:]) // 8
    tick_positions.append(first_byte + 0.5 * (size - 1))
    tick_labels.append(f"{field.get('name', '')}\n{field['type']}")
    first_byte += size
frame_bytes = np.frombuffer(b"".join(frames[:60]), np.uint8).reshape(60, -1)
plt.figure(figsize=(6.4, 4.8), layout="constrained")
plt.imshow(frame_bytes, aspect="auto", cmap="Blues")
plt.xticks(tick_positions, tick_labels)
plt.gca().set(ylabel="frame", title="bytes of 60 frames, and the recognised fields")
plt.show()
