"""Problem of a calibration: the films that a sensor may have, and the contacts for which a model is needed."""

from dataclasses import dataclass
from functools import cached_property

from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS, DEFAULT_STRESS_LIMIT
from isocharge.common.errors import SensorError
from isocharge.simulate import Domain, FilmPrior, NoiseModel, Probe, Sensor
from isocharge.simulate.forward.charge_map import check_electrode_count
from isocharge.simulate.forward.family import check_family
from isocharge.simulate.noise import NOISE_LEVELS
from isocharge.simulate.sensor.film_properties import PRETENSION
from isocharge.train.calibration.film_charges import round_probe
from isocharge.train.calibration.film_estimate import PLANNING_SIZES, FilmEstimate, Layout, Prior

POSITION_MARGIN_MM = 0.5
"""Distance by which the solved presses extend beyond the working area, mm, to allow for errors of the places."""

FORCE_MARGIN = 1.25
"""Ratio by which the solved forces extend beyond the range of forces, to allow for errors of the forces."""

RIM_MARGIN = 1.3
"""Smallest distance of a solved press from the clamp, in units of the reach of the largest probe."""


@dataclass(frozen=True)
class CalibrationProblem:
    """Problem of a calibration.

    Attributes:
        sensor: The sensor as described in its file.
        probe: The probe as described.
        radius: Radius of the working area, mm.
        force_range: Smallest and largest force of a contact, N.
        earlier: Estimate of an earlier calibration, with the drift since then; None to begin with the sensor file.
        stress_limit: Largest stress of the film that a proposed press may cause, MPa.
        noise: Smallest noise of the charges, which is the noise of a good amplifier. The presses may show a larger
            noise.

    Example:
        >>> problem = CalibrationProblem(load_sensor("four-25um-biaxial"), Circle(1.0))  # doctest: +SKIP
        >>> result = calibrate(read_presses(Path("presses.csv")), problem)  # doctest: +SKIP
        >>> write_calibration(result, Path("my-film"))  # doctest: +SKIP
    """

    sensor: Sensor
    probe: Probe
    radius: float = DEFAULT_RADIUS
    force_range: tuple[float, float] = DEFAULT_FORCE_RANGE
    earlier: FilmEstimate | None = None
    stress_limit: float = DEFAULT_STRESS_LIMIT
    noise: NoiseModel = NOISE_LEVELS["reference"]

    def __post_init__(self) -> None:
        """Check the electrodes, the working area, and the pretension of the film that the sensor file describes.

        Raises:
            SceneError: If there are fewer than three electrodes, or if a press at the edge of the working area cannot
                exist.
            SensorError: If the pretension of the film is too large.
        """
        check_electrode_count(len(self.sensor.electrodes))
        check_family(self.sensor.film, self.probe, self.domain)  # the press at the edge of the working area can exist
        _, largest = PRETENSION.limits  # smallest and largest pretension, MPa
        if self.sensor.film.pretension > largest:
            raise SensorError(
                f"{self.sensor.name}: film.pretension_MPa: expected at most {largest:g} MPa, up to which a calibration "
                f"searches, got {self.sensor.film.pretension:g}; train on many presses instead (`isocharge train fit`)"
            )

    @property
    def electrodes(self) -> tuple[str, ...]:
        """Names of the electrodes of the sensor."""
        return self.sensor.electrode_names

    @cached_property
    def prior(self) -> Prior:
        """Prior distribution of the unknowns."""
        return Prior(Layout(FilmPrior(self.sensor, self.probe)), self.earlier)

    @property
    def film_before(self) -> FilmEstimate:
        """Distribution of the unknowns before the presses, with which the first presses are planned."""
        return FilmEstimate(self.prior.layout, self.prior.mean, self.prior.covariance(PLANNING_SIZES), self.noise)

    @property
    def domain(self) -> Domain:
        """Contacts that the model will answer, and that a calibration accepts."""
        return Domain(self.radius, self.force_range)

    @property
    def solved_domain(self) -> Domain:
        """Contacts for which the film is solved. They extend beyond `domain`, because measured presses have errors."""
        low, high = self.force_range
        largest_force = high * FORCE_MARGIN
        # The solved presses must keep a distance from the clamp. It depends on the reach of the probe under the largest
        # force, because a fingertip grows with the force. The probe may be replaced by a circle with another reach.
        probe = self.probe.under(largest_force)
        reach = max(probe.reach, round_probe(probe).reach)
        largest_radius = self.sensor.film.inner_radius - RIM_MARGIN * reach
        # A working area that leaves too small a distance is solved without a margin.
        radius = min(self.radius + POSITION_MARGIN_MM, max(self.radius, largest_radius))
        return Domain(radius, (low / FORCE_MARGIN, largest_force))


def domain_words(domain: Domain) -> str:
    """Describe a domain, for example as "within 8 mm of the centre and of 0.05 to 2 N"."""
    low, high = domain.force_range
    return f"within {domain.radius:.3g} mm of the centre and of {low:.2g} to {high:.2g} N"
