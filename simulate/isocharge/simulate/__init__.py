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

if TYPE_CHECKING:  # each `as` marks a public name (PEP 484); isort would split the statements
    # isort: off
    from isocharge.common.contact_domain import Domain as Domain
    from isocharge.simulate.dataset.shards import (
        Dataset as Dataset,
        Samples as Samples,
        read_dataset as read_dataset,
        write_dataset as write_dataset,
    )
    from isocharge.simulate.dataset.sweep import Sweep as Sweep, run_sweep as run_sweep
    from isocharge.simulate.execution import dask_workers as dask_workers, local_workers as local_workers
    from isocharge.simulate.forward.charge_map import ChargeMap as ChargeMap
    from isocharge.simulate.forward.charge_spline import ChargeSpline as ChargeSpline
    from isocharge.simulate.forward.derivative_maps import FilmSlopes as FilmSlopes
    from isocharge.simulate.forward.forward_map import ForwardMap as ForwardMap
    from isocharge.simulate.forward.readout import touch_charge as touch_charge
    from isocharge.simulate.identifiability.cramer_rao import limits_at as limits_at
    from isocharge.simulate.identifiability.identification import identify as identify
    from isocharge.simulate.identifiability.triangulation import Triangulation as Triangulation
    from isocharge.simulate.identifiability.working_area import working_area as working_area
    from isocharge.simulate.layout.case import DesignCase as DesignCase
    from isocharge.simulate.layout.design import design as design
    from isocharge.simulate.measuring_chain import (
        Amplifier as Amplifier,
        load_amplifier as load_amplifier,
        noise_model as noise_model,
    )
    from isocharge.simulate.mechanics.theory import Theory as Theory
    from isocharge.simulate.mesh.blocks import Resolution as Resolution
    from isocharge.simulate.noise import NoiseModel as NoiseModel
    from isocharge.simulate.sensor.film import Film as Film, Piezo as Piezo
    from isocharge.simulate.sensor.film_properties import FilmPrior as FilmPrior, virtual_film as virtual_film
    from isocharge.simulate.sensor.footprint import Probe as Probe
    from isocharge.simulate.sensor.probe import (
        Circle as Circle,
        Ellipse as Ellipse,
        Finger as Finger,
        GrowingFinger as GrowingFinger,
        Polygon as Polygon,
        parse_probe as parse_probe,
    )
    from isocharge.simulate.sensor.sensor import Calibration as Calibration, Electrode as Electrode, Sensor as Sensor
    from isocharge.simulate.sensor.sensor_file import (
        built_in_sensors as built_in_sensors,
        load_sensor as load_sensor,
        write_sensor as write_sensor,
    )
    from isocharge.simulate.solver.equilibrium import (
        Equilibrium as Equilibrium,
        deflection as deflection,
        touch_stress as touch_stress,
    )
    from isocharge.simulate.solver.load_case import SolveSettings as SolveSettings
    from isocharge.simulate.solver.press import press as press
else:  # hidden from type checkers, which would otherwise accept every misspelt name
    __getattr__, __dir__, __all__ = lazy_names(__name__, "simulate")

__version__: str
