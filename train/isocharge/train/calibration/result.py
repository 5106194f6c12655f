"""Result of a calibration: the estimate of the film, its errors, and sentences for the user."""

from dataclasses import dataclass
from functools import cached_property

from isocharge.serve.presses.measured_presses import MeasuredPresses
from isocharge.simulate import Probe, Sensor
from isocharge.train.calibration.contact_error import ContactError, ContactSensitivity
from isocharge.train.calibration.estimator import Estimation
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.film_estimate import FilmEstimate
from isocharge.train.calibration.problem import CalibrationProblem

IDENTIFIED_RATIO = 0.5
"""A property counts as identified if the presses reduce its standard deviation to at most this fraction."""


@dataclass(frozen=True)
class PropertyEstimate:
    """Estimate of one property of a film.

    Attributes:
        meaning: Description of the property.
        unit: Unit of the property.
        value: Most probable value.
        std: Standard deviation after the presses.
        before_std: Standard deviation before the presses.
        identified: Whether the presses have reduced the standard deviation by at least half.
    """

    meaning: str
    unit: str
    value: float
    std: float
    before_std: float
    identified: bool


@dataclass(frozen=True)
class CalibrationResult:
    """Result of a calibration.

    Attributes:
        problem: The calibration problem.
        presses: The presses, including the bad presses that were left out of the estimate.
        estimation: Result of the estimator.
        sensitivity: Effects of noise and of errors of the film on estimated contacts.
        cautions: Warnings for the user.
    """

    problem: CalibrationProblem
    presses: MeasuredPresses
    estimation: Estimation
    sensitivity: ContactSensitivity
    cautions: tuple[str, ...] = ()

    @property
    def charges(self) -> FilmCharges:
        """The solved film."""
        return self.estimation.charges

    @property
    def film(self) -> FilmEstimate:
        """The estimate of the film."""
        return self.estimation.film

    @cached_property
    def sensor_and_probe(self) -> tuple[Sensor, Probe]:
        """The calibrated sensor and probe."""
        return self.film.layout.prior.film(self.film.film_values)

    @property
    def bad_lines(self) -> tuple[int, ...]:
        """Numbers of the lines of presses that were left out."""
        return self.presses[self.estimation.is_bad].lines

    @cached_property
    def film_error(self) -> ContactError:
        """Errors of contacts that the remaining uncertainty of the film causes."""
        return self.sensitivity.film_error(self.film.covariance)

    @cached_property
    def film_error_before(self) -> ContactError:
        """Errors of contacts that the uncertainty of the film would cause without the presses."""
        return self.sensitivity.film_error(self.problem.film_before.covariance)

    @cached_property
    def properties(self) -> dict[str, PropertyEstimate]:
        """Properties of the film by name, with their standard deviations before and after the presses.

        The standard deviation before the presses is that of an earlier calibration. Without an earlier calibration, it
        is the declared standard deviation. The presses identify a property if they reduce its standard deviation to at
        most the fraction `IDENTIFIED_RATIO`.
        """
        before = self.problem.film_before
        estimates = {}
        for declared in self.film.layout.prior.properties:
            name = declared.name
            # After an earlier calibration, `film_before` is its estimate. Otherwise, `film_before` is used to plan
            # presses, and has only half of the declared standard deviations of imperfections.
            before_std = declared.std if self.problem.earlier is None else before.std(name)
            value = self.film.value(name)
            std = self.film.std(name)
            is_identified = std <= IDENTIFIED_RATIO * before_std
            estimates[name] = PropertyEstimate(declared.meaning, declared.unit, value, std, before_std, is_identified)
        return estimates

    @property
    def summary(self) -> tuple[str, ...]:
        """Sentences about contact errors, the properties that the presses determine, the discrepancy, and the noise."""
        after = self.film_error  # errors of contacts after the presses
        before = self.film_error_before
        noise = self.sensitivity.noise_error
        sentences = [
            f"The uncertainty of the film causes errors of {after.position_mm:.2g} mm and {after.force_percent:.2g} % "
            f"(before the presses {before.position_mm:.2g} mm and {before.force_percent:.2g} %); noise alone causes "
            f"{noise.position_mm:.2g} mm and {noise.force_percent:.2g} %."
        ]
        identified = [estimate for estimate in self.properties.values() if estimate.identified]
        if identified:
            texts = [  # the unit of a ratio, " 1", is not shown
                f"{estimate.meaning} {estimate.value:.3g} +- {estimate.std:.2g} {estimate.unit}".removesuffix(" 1")
                for estimate in identified
            ]
            sentences.append(
                "The presses determine the following changes from the sensor file (of the mean pretension, the value "
                f"itself): {'; '.join(texts)}."
            )
        unidentified = [name.replace("_", " ") for name, estimate in self.properties.items() if not estimate.identified]
        if unidentified:
            sentences.append(
                f"They hardly determine {', '.join(unidentified)}. Contacts depend only on combinations of these "
                "properties, which are known better."
            )
        hypothesis = self.estimation.hypothesis
        sentences.append(
            f"Differences that no property describes: about {100.0 * hypothesis.discrepancy:.2g} % of a charge; noise: "
            f"about {100.0 * self.film.noise.gain:.2g} % and {self.film.noise.white:.2g} pC."
        )
        return tuple(sentences)
