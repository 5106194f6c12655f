"""
How do I calibrate a real film?
===============================

This example calibrates a film by eight presses with known positions and forces. The pretension of this film is larger
than the pretension in the sensor file. The released model therefore has a position error of about 3 mm rms. The
calibrated model has an error of 0.2 mm rms, which is mostly caused by the noise of light presses.
"""

import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from isocharge.serve import Predictor, read_presses
from isocharge.simulate import Circle, load_sensor
from isocharge.simulate.plots.film import draw_electrodes, frame_film
from isocharge.train import CalibrationProblem, calibrate, write_calibration

sensor = load_sensor("four-25um-biaxial")
presses = read_presses(Path(sys.argv[0]).parent / "presses.csv")
result = calibrate(presses, CalibrationProblem(sensor, Circle(1.0)))
print(f"{len(presses)} presses: the pretension is {result.film.value('pretension'):.2f} MPa")
remaining_error = result.film_error
print(f"error that the film still causes: {remaining_error.position_mm:.2f} mm, {remaining_error.force_percent:.1f} %")
for caution in result.cautions:
    print("caution:", caution)
with tempfile.TemporaryDirectory() as temporary:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else temporary) / "film"
    write_calibration(result, folder)
    predictors = {"released": Predictor(sensor.name), "calibrated": Predictor(folder)}

figure, axes = plt.subplots(figsize=(6.0, 6.0), layout="constrained")
axes.plot(*presses.contact[:, :2].T, "k+", ms=10, label="true positions")
for name, predictor in predictors.items():
    answers = predictor.predict_batch(presses.charge_pC)
    error = np.hypot(answers.x_mm - presses.contact[:, 0], answers.y_mm - presses.contact[:, 1])
    print(f"{name} model: position error {np.sqrt(np.mean(error**2)):.2f} mm rms")
    axes.plot(answers.x_mm, answers.y_mm, "o", ms=4, label=f"{name} model")
draw_electrodes(axes, sensor)
axes.legend()
frame_film(axes, sensor, 8.0, "estimated positions of the presses")
plt.show()
