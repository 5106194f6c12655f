"""The simulator: from a press on a clamped piezoelectric film to the charges of its electrodes.

Five lines give the charges of one press.

    from isocharge.simulate import Circle, load_sensor, press, touch_charge

    sensor = load_sensor("three-25um-biaxial")
    equilibrium = press(sensor.film, Circle(radius=1e-3), at=(2e-3, 3e-3), force=1.0)
    charge = touch_charge(sensor, equilibrium)  # C, in the order of sensor.electrode_names
"""

from typing import TYPE_CHECKING

from isocharge.common.extras import require
from isocharge.common.versions import version_attribute

with require("simulate"):
    from isocharge.simulate.artwork.leads import Leads, route
    from isocharge.simulate.contours.charge_curves import Curves, Mapping
    from isocharge.simulate.contours.field_contours import Contour, ContourField
    from isocharge.simulate.contours.fix import Fix, Meeting
    from isocharge.simulate.contours.graphical_method import DrawnContour, DrawnTriangulation, draw_contour
    from isocharge.simulate.contours.triangulation import Triangulation
    from isocharge.simulate.dataset.callbacks import SweepCallbacks
    from isocharge.simulate.dataset.sampling import Sweep
    from isocharge.simulate.dataset.shards import Dataset, Samples, read_dataset, write_dataset
    from isocharge.simulate.dataset.sweep import run_sweep, solve_maps, write_sweep
    from isocharge.simulate.forward.charge_model import ChargeFunction
    from isocharge.simulate.forward.charge_spline import ChargeSpline
    from isocharge.simulate.forward.film_family import FilmFamily
    from isocharge.simulate.forward.forward_map import ForwardMap
    from isocharge.simulate.forward.readout import contact_charge, pretension_charge, thermal_charge, touch_charge
    from isocharge.simulate.identifiability.cramer_rao import CramerRao, limits_at
    from isocharge.simulate.identifiability.layout_assessment import LayoutAssessment, assess_layout
    from isocharge.simulate.identifiability.working_area import WorkingArea, working_area
    from isocharge.simulate.layout.design import Design, design, run_design
    from isocharge.simulate.layout.scene import Nuisances
    from isocharge.simulate.layout.task import DesignTask
    from isocharge.simulate.measuring_chain.amplifier import Amplifier, Measurement
    from isocharge.simulate.measuring_chain.noise import NoiseModel
    from isocharge.simulate.measuring_chain.noise_file import load_amplifier, noise_model
    from isocharge.simulate.mechanics.theory import Theory, theory_for
    from isocharge.simulate.mesh.resolution import Resolution
    from isocharge.simulate.sensor.electrode import Calibration, Electrode
    from isocharge.simulate.sensor.film import Film, Piezo
    from isocharge.simulate.sensor.film_prior import FilmPrior, FilmSpread, virtual_film
    from isocharge.simulate.sensor.probe import Circle, Polygon, Probe, parse_probe
    from isocharge.simulate.sensor.sensor import Sensor
    from isocharge.simulate.sensor.sensor_file import (
        built_in_sensors,
        load_sensor,
        sensor_from_dict,
        sensor_to_dict,
        sensor_to_toml,
        write_sensor,
    )
    from isocharge.simulate.solver.equilibrium import Equilibrium
    from isocharge.simulate.solver.press import press
    from isocharge.simulate.solver.settings import SolveSettings

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
    "Design",
    "DesignTask",
    "DrawnContour",
    "DrawnTriangulation",
    "Electrode",
    "Equilibrium",
    "Film",
    "FilmFamily",
    "FilmPrior",
    "FilmSpread",
    "Fix",
    "ForwardMap",
    "LayoutAssessment",
    "Leads",
    "Mapping",
    "Measurement",
    "Meeting",
    "NoiseModel",
    "Nuisances",
    "Piezo",
    "Polygon",
    "Probe",
    "Resolution",
    "Samples",
    "Sensor",
    "SolveSettings",
    "Sweep",
    "SweepCallbacks",
    "Theory",
    "Triangulation",
    "WorkingArea",
    "assess_layout",
    "built_in_sensors",
    "contact_charge",
    "design",
    "draw_contour",
    "limits_at",
    "load_amplifier",
    "load_sensor",
    "noise_model",
    "parse_probe",
    "press",
    "pretension_charge",
    "read_dataset",
    "route",
    "run_design",
    "run_sweep",
    "sensor_from_dict",
    "sensor_to_dict",
    "sensor_to_toml",
    "solve_maps",
    "theory_for",
    "thermal_charge",
    "touch_charge",
    "virtual_film",
    "working_area",
    "write_dataset",
    "write_sensor",
    "write_sweep",
]

__version__: str
if not TYPE_CHECKING:  # a type checker would take every misspelt name for a text
    __getattr__ = version_attribute(__name__)
