"""Simulator that computes the charges of the electrodes when a probe presses on a clamped piezoelectric film.

Lengths are in mm, forces in N, stresses in MPa and charges in pC.

Example:

    from isocharge.simulate import Circle, load_sensor, press, touch_charge

    sensor = load_sensor("three-25um-biaxial")
    equilibrium = press(sensor.film, Circle(1.0), at=(2.0, 3.0), force=1.0)
    charge = touch_charge(sensor, equilibrium)  # pC, in the order of sensor.electrode_names
"""

from typing import TYPE_CHECKING

from isocharge.common.errors import lazy_names, require

with require("simulate"):
    import scipy  # noqa: F401 (all modules need it; the error names the extra)

if TYPE_CHECKING:
    from isocharge.common.contact_domain import Domain
    from isocharge.simulate.dataset.shards import Dataset, Samples, read_dataset, write_dataset
    from isocharge.simulate.dataset.sweep import Sweep, run_sweep
    from isocharge.simulate.execution import dask_workers, local_workers
    from isocharge.simulate.forward.charge_map import ChargeMap
    from isocharge.simulate.forward.charge_spline import ChargeSpline
    from isocharge.simulate.forward.derivative_maps import FilmSlopes
    from isocharge.simulate.forward.forward_map import ForwardMap
    from isocharge.simulate.forward.readout import touch_charge
    from isocharge.simulate.identifiability.cramer_rao import limits_at
    from isocharge.simulate.identifiability.identification import identify
    from isocharge.simulate.identifiability.triangulation import Triangulation
    from isocharge.simulate.identifiability.working_area import working_area
    from isocharge.simulate.layout.case import DesignCase
    from isocharge.simulate.layout.design import design
    from isocharge.simulate.measuring_chain import Amplifier, load_amplifier, noise_model
    from isocharge.simulate.mechanics.theory import Theory
    from isocharge.simulate.mesh.blocks import Resolution
    from isocharge.simulate.noise import NoiseModel
    from isocharge.simulate.sensor.film import Film, Piezo
    from isocharge.simulate.sensor.film_properties import FilmPrior, virtual_film
    from isocharge.simulate.sensor.footprint import Probe
    from isocharge.simulate.sensor.probe import Circle, Ellipse, Finger, GrowingFinger, Polygon, parse_probe
    from isocharge.simulate.sensor.sensor import Calibration, Electrode, Sensor
    from isocharge.simulate.sensor.sensor_file import built_in_sensors, load_sensor, write_sensor
    from isocharge.simulate.solver.equilibrium import Equilibrium, deflection, touch_stress
    from isocharge.simulate.solver.load_case import SolveSettings
    from isocharge.simulate.solver.press import press
else:  # hidden from type checkers, which would otherwise accept every misspelt name
    __getattr__ = lazy_names(__name__, "simulate")

__all__ = [
    "Amplifier",
    "Calibration",
    "ChargeMap",
    "ChargeSpline",
    "Circle",
    "Dataset",
    "DesignCase",
    "Domain",
    "Electrode",
    "Ellipse",
    "Equilibrium",
    "Film",
    "FilmPrior",
    "FilmSlopes",
    "Finger",
    "ForwardMap",
    "GrowingFinger",
    "NoiseModel",
    "Piezo",
    "Polygon",
    "Probe",
    "Resolution",
    "Samples",
    "Sensor",
    "SolveSettings",
    "Sweep",
    "Theory",
    "Triangulation",
    "built_in_sensors",
    "dask_workers",
    "deflection",
    "design",
    "identify",
    "limits_at",
    "load_amplifier",
    "load_sensor",
    "local_workers",
    "noise_model",
    "parse_probe",
    "press",
    "read_dataset",
    "run_sweep",
    "touch_charge",
    "touch_stress",
    "virtual_film",
    "working_area",
    "write_dataset",
    "write_sensor",
]

__version__: str


def __dir__() -> list[str]:
    """Return the public names, so that tab completion suggests no other names."""
    return list(__all__)
