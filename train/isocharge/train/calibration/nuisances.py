"""Nuisances of a session, which are unknowns of the fit that are not properties of the film.

`NUISANCES` declares each nuisance once: its name and unit, its standard deviation before the presses, and its effect on
the charges or on the pretension. All effects are proportional to the value of the nuisance, so that the derivatives
follow from the effect of the value 1.

Nuisances are not stored after the session. The only exception is the change of the pretension with temperature
(`problem.Warming`), which the next calibration needs.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array
from isocharge.train.calibration.press_data import PressData


class NuisanceEstimate(NamedTuple):
    """Estimate of a nuisance.

    Attributes:
        value: Estimated value, in the unit of the nuisance.
        std: Standard deviation of the value, in the same unit.
    """

    value: float
    std: float


@dataclass(frozen=True)
class Nuisance:
    """Declaration of a nuisance. Each kind of nuisance is a subclass that defines the effect of the nuisance.

    Attributes:
        name: Name of the nuisance.
        unit: Unit of the nuisance.
        probabilities: Considered standard deviations before the presses, each with its prior probability. The presses
            determine which of these hypotheses is probable (`hypotheses`). By default, only zero is considered.
        std_with_temperatures: Standard deviation before the presses if the temperatures of the presses are known; zero
            for a nuisance that does not depend on temperature.
    """

    name: str
    unit: str
    probabilities: tuple[tuple[float, float], ...] = ((0.0, 1.0),)
    std_with_temperatures: float = 0.0

    def charge_error(self, data: PressData, value: float) -> Array:
        """Return the charges that the nuisance adds to the measured charges, shape (n, n_electrode), pC."""
        del value
        return np.zeros_like(data.charge)

    def tension_change(self, data: PressData, value: float) -> Array:
        """Return the change of the pretension during each press, shape (n,), MPa."""
        del value
        return np.zeros(len(data))

    def gain_std(self, estimate: NuisanceEstimate) -> float:
        """Return the relative standard deviation that the nuisance adds to all gains when the film is used later."""
        del estimate
        return 0.0

    def caution(self, estimate: NuisanceEstimate) -> str:
        """Return the warning for the user if the session probably has this nuisance."""
        return f"the session has {self.name}: {estimate.value:.2g} +- {estimate.std:.2g} {self.unit}; it is subtracted"


class PretensionPerKelvin(Nuisance):
    """Change of the pretension with temperature, which occurs because film and ring expand differently."""

    def tension_change(self, data: PressData, value: float) -> Array:
        """Return the change of the pretension relative to that at the mean temperature of the presses."""
        return value * data.warming_K


class PretensionPerFilmExcess(Nuisance):
    """Change of the pretension for each kelvin by which the film is warmer than its ring.

    A film that is warmer than its ring slackens.
    """

    def tension_change(self, data: PressData, value: float) -> Array:
        """Return the change of the pretension relative to that at the mean temperature difference."""
        return value * data.film_excess_K


class ChargeOffset(Nuisance):
    """Common offset of all charges, for example because of a wrong tare."""

    def charge_error(self, data: PressData, value: float) -> Array:
        """Return the offset for every charge."""
        return np.full_like(data.charge, value)

    def caution(self, estimate: NuisanceEstimate) -> str:
        """Return the warning about the tare."""
        return (
            f"the charges are {estimate.value:.2g} +- {estimate.std:.2g} pC too large in all presses and electrodes: "
            "is the tare right? The offset is subtracted"
        )


class ChargeDrift(Nuisance):
    """Proportional drift of all charges from the first press to the last."""

    def charge_error(self, data: PressData, value: float) -> Array:
        """Return the drift of each charge, from minus half the drift at the first press to plus half at the last."""
        return value * data.session_time[:, None] * data.charge

    def gain_std(self, estimate: NuisanceEstimate) -> float:
        """Return the standard deviation of a uniform distribution over the range of the drift."""
        return float(np.hypot(estimate.value, estimate.std) / np.sqrt(12.0))

    def caution(self, estimate: NuisanceEstimate) -> str:
        """Return the warning about the drift."""
        return (
            f"the charges are {100.0 * estimate.value:.2g} +- {100.0 * estimate.std:.2g} % larger at the end than at "
            "the beginning: does an amplifier drift? The drift is subtracted"
        )


class Friction(Nuisance):
    """Coefficient of friction of the tip, if the presses were made on a vertical stage; see `side_forces`."""

    def charge_error(self, data: PressData, value: float) -> Array:
        """Return the charges that friction adds."""
        return value * data.friction_charge


PRETENSION_PER_KELVIN = PretensionPerKelvin("pretension_per_K", "MPa/K", std_with_temperatures=0.4)
"""Change of the pretension with temperature.

Its standard deviation before the presses is E da / (1 - nu), which is 0.3 to 0.44 MPa/K on aluminium.
"""

PRETENSION_PER_FILM_EXCESS = PretensionPerFilmExcess("pretension_per_film_K", "MPa/K", std_with_temperatures=0.6)
"""Change of the pretension per kelvin of the film above its ring.

Its standard deviation before the presses exceeds E a / (1 - nu), which is 0.4 to 0.55 MPa/K.
"""

FRICTION = Friction("friction", "1")
"""Coefficient of friction of the tip.

It is zero unless the calibration states an expected coefficient (`CalibrationProblem.friction`), which is then also its
standard deviation before the presses.
"""

NUISANCES: tuple[Nuisance, ...] = (
    PRETENSION_PER_KELVIN,
    PRETENSION_PER_FILM_EXCESS,
    ChargeOffset("offset", "pC", ((0.0, 0.9), (30.0, 0.1))),
    ChargeDrift("drift", "1", ((0.0, 0.95), (0.15, 0.05))),
    FRICTION,
)
"""All nuisances, in the order in which they appear in the vector of unknowns."""


def film_warming_sentences(estimates: Mapping[str, NuisanceEstimate]) -> Iterator[str]:
    """Yield a sentence about the effect of a film that is warmer than its ring, if the presses determine the effect.

    Args:
        estimates: Estimates of the nuisances by name.
    """
    estimate = estimates[PRETENSION_PER_FILM_EXCESS.name]
    if 0.0 < estimate.std <= 0.5 * PRETENSION_PER_FILM_EXCESS.std_with_temperatures:
        yield (
            f"The pretension changes by {estimate.value:.3g} +- {estimate.std:.2g} MPa per kelvin that the film is "
            "warmer than its ring. The result holds for the mean difference of both temperatures."
        )


def without_nuisances(data: PressData, values: Sequence[float] | Array) -> PressData:
    """Subtract the charges of the nuisances from presses, and set the pretension during each press.

    Args:
        data: The presses as they were measured.
        values: Value of each nuisance, in the order of `NUISANCES`.
    """
    charge = data.charge
    tension_change = np.zeros(len(data))
    for nuisance, value in zip(NUISANCES, values, strict=True):
        charge = charge - nuisance.charge_error(data, value)
        tension_change = tension_change + nuisance.tension_change(data, value)
    return replace(data, charge=charge, tension_change=tension_change)


def nuisance_derivatives(data: PressData, pretension_derivative: Array) -> Array:
    """Compute the derivatives of the residuals with respect to the nuisances.

    A nuisance adds charge, or changes the pretension, in proportion to its value. The effects of a value of 1 are
    therefore the derivatives.

    Args:
        data: The presses as they were measured.
        pretension_derivative: Derivatives of the residuals with respect to the pretension, shape (n, n_electrode + 3),
            1/MPa.

    Returns:
        Derivatives, shape (n, n_electrode + 3, n_nuisance).
    """
    rig_derivative = np.zeros((len(data), 3))  # nuisances do not change the contact that the rig measured
    derivatives = []
    for nuisance in NUISANCES:
        charge_derivative = data.weight * nuisance.charge_error(data, 1.0)
        by_charge = np.column_stack([charge_derivative, rig_derivative])
        by_tension = pretension_derivative * nuisance.tension_change(data, 1.0)[:, None]
        derivatives.append(by_charge + by_tension)
    return np.stack(derivatives, axis=2)
