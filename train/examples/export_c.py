"""
How do I get the model into a microcontroller?
==============================================

As C99 without dependencies: a folder with the network, the signal chain of a board and a self-test. Its answers are
those of ONNX Runtime to some units in the last place, ten thousand times less than the error by noise.
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
    answer = (ctypes.c_float * 7)()
    answers = []
    for row in charge.tolist():
        predict((ctypes.c_float * 4)(*row), answer)
        answers.append(answer[:2])
    by_runtime = np.stack(Predictor(name).predict_batch(charge)[:2], axis=1)
    error, difference = (np.hypot(*(np.array(answers) - other).T) for other in (contact[:, :2], by_runtime))
    print(f"{name}: {np.median(error):.3f} mm from the press, {difference.max():.1e} mm from ONNX Runtime")
    for values, style in ((error, "-"), (difference.clip(1e-9), ":")):
        plt.plot(np.sort(values), np.linspace(0.0, 1.0, len(values)), style, label=name if style == "-" else None)
plt.gca().set(xscale="log", xlabel="mm: from the press, and dotted from ONNX Runtime", ylabel="share of presses")
plt.legend()
plt.show()
