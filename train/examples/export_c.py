"""
How do I get the model into a microcontroller?
==============================================

The function ``export_c`` writes a model as C99 without dependencies. The folder contains the network, the signal chain
of a board, and a self-test. This example compiles the network and calls it from Python. The positions computed in C
differ from those of ONNX Runtime by less than 0.00001 mm. The error that noise causes is thousands of times larger.
"""

import ctypes
import subprocess
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from isocharge.serve import Predictor, find_model
from isocharge.simulate import Circle, ForwardMap, Sweep, load_sensor, noise_model
from isocharge.train.export_c.folder import export_c

contact = Sweep(8.0, (0.05, 2.0), samples=2000).contacts()
sensor = load_sensor("four-25um-biaxial")
charge = noise_model("reference").add(ForwardMap.build(sensor, Circle(1.0)).charges(contact), np.random.default_rng(0))
for name in ("four-25um-biaxial", "four-25um-biaxial-student"):
    with tempfile.TemporaryDirectory() as temporary:
        folder = export_c(find_model(name), Path(temporary) / "c")
        library = Path(temporary) / "model.so"
        compiler = ("cc", "-std=c99", "-O2", "-shared", "-fPIC", "-o", library)
        subprocess.run([*compiler, folder / "isocharge_model.c", "-lm"], check=True)
        predict = ctypes.CDLL(str(library)).isocharge_predict
    answer = (ctypes.c_float * 7)()  # x, y, force, their standard deviations, misfit
    positions = []
    for row in charge.tolist():
        predict((ctypes.c_float * 4)(*row), answer)
        positions.append(answer[:2])
    c_position = np.array(positions)
    runtime_position = np.stack(Predictor(name).predict_batch(charge)[:2], axis=1)
    error = np.hypot(*(c_position - contact[:, :2]).T)
    difference = np.hypot(*(c_position - runtime_position).T)
    print(
        f"{name}: median position error {np.median(error):.3f} mm, largest difference from ONNX Runtime "
        f"{difference.max():.1e} mm"
    )
    share = np.linspace(0.0, 1.0, len(error))
    (line,) = plt.plot(np.sort(error), share, label=f"{name}: error")
    plt.plot(
        np.sort(difference.clip(1e-9)),
        share,
        ":",
        color=line.get_color(),
        label=f"{name}: difference from ONNX Runtime",
    )
plt.gca().set(xscale="log", xlabel="distance of the positions, mm", ylabel="share of presses")
plt.legend()
plt.show()
