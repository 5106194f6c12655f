"""Calibrate a real film by a few measured presses, see what they say, and write its model folder."""

import sys
from pathlib import Path

from isocharge.serve import Predictor, read_presses
from isocharge.simulate import Circle, load_sensor
from isocharge.train import CalibrationProblem, calibrate, write_calibration

sensor, presses = load_sensor("four-25um-biaxial"), read_presses(Path(__file__).parent / "presses.csv")
result = calibrate(presses, CalibrationProblem.of(sensor, Circle(1.0)))
print(f"{len(presses)} presses: {result.film[0].film.pretension:.2f} MPa of pretension")
print(f"left by not knowing the film: {result.left.position_mm:.2f} mm, {result.left.force_percent:.1f} %")
for caution in result.cautions:
    print("caution:", caution)
folder = Path(sys.argv[1])
write_calibration(result, folder)
contact = Predictor(folder).predict(presses.charge_pC[0])
print(f"first press: ({contact.x_mm:.1f}, {contact.y_mm:.1f}) mm, {contact.force_N:.2f} N")
