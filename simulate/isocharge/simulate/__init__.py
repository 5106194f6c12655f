"""The simulator: from a press on a clamped piezoelectric film to the charges of its electrodes.

from isocharge.simulate import Circle, load_sensor, press, touch_charge

sensor = load_sensor("three-25um-biaxial")
equilibrium = press(sensor.film, Circle(radius=1e-3), at=(2e-3, 3e-3), force=1.0)
charge = touch_charge(sensor, equilibrium)  # C, in the order of sensor.electrode_names
"""

from isocharge.extras import require

with require("simulate"):
    from isocharge.simulate.amplifier import Amplifier, Measurement, load_amplifier
    from isocharge.simulate.charge import contact_charge, pretension_charge, thermal_charge, touch_charge
    from isocharge.simulate.charge_spline import ChargeSpline
    from isocharge.simulate.contours import Contour, ContourField
    from isocharge.simulate.curves import Curves, Mapping
    from isocharge.simulate.dataset import Dataset, Samples, read_dataset, write_dataset
    from isocharge.simulate.drawn import DrawnContour, DrawnTriangulation, draw_contour
    from isocharge.simulate.equilibrium import Equilibrium
    from isocharge.simulate.forward import ForwardMap
    from isocharge.simulate.limits import ChargeFunction, CramerRao, limits_at
    from isocharge.simulate.noise import NoiseModel, noise_model
    from isocharge.simulate.probe import Circle, Polygon, Probe, parse_probe
    from isocharge.simulate.sampling import Sweep
    from isocharge.simulate.sensor import Calibration, Electrode, Film, Piezo, Sensor
    from isocharge.simulate.sensor_file import built_in_sensors, load_sensor, sensor_from_dict, sensor_to_dict
    from isocharge.simulate.solve import press
    from isocharge.simulate.sweep import run_sweep, solve_maps, write_sweep
    from isocharge.simulate.template import Resolution
    from isocharge.simulate.theory import Theory, theory_for
    from isocharge.simulate.triangulation import Fix, Meeting, Triangulation
    from isocharge.simulate.working_area import WorkingArea, working_area

__all__ = [
    "Amplifier",
    "Calibration",
    "ChargeFunction",
    "ChargeSpline",
    "Circle",
    "Contour",
    "ContourField",
    "CramerRao",
    "Curves",
    "Dataset",
    "DrawnContour",
    "DrawnTriangulation",
    "Electrode",
    "Equilibrium",
    "Film",
    "Fix",
    "ForwardMap",
    "Mapping",
    "Measurement",
    "Meeting",
    "NoiseModel",
    "Piezo",
    "Polygon",
    "Probe",
    "Resolution",
    "Samples",
    "Sensor",
    "Sweep",
    "Theory",
    "Triangulation",
    "WorkingArea",
    "built_in_sensors",
    "contact_charge",
    "draw_contour",
    "limits_at",
    "load_amplifier",
    "load_sensor",
    "noise_model",
    "parse_probe",
    "press",
    "pretension_charge",
    "read_dataset",
    "run_sweep",
    "sensor_from_dict",
    "sensor_to_dict",
    "solve_maps",
    "theory_for",
    "thermal_charge",
    "touch_charge",
    "working_area",
    "write_dataset",
    "write_sweep",
]
