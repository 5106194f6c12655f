"""Nuisances of a session: unknowns of a fit that are not properties of the film.

Each nuisance in `NUISANCES` defines its name, its unit, its prior standard deviation, and its effect on the charges or
on the pretension. The effect of a nuisance is proportional to its value. Therefore, the derivative with respect to a
nuisance is the effect of the value 1.

After the session, only one nuisance is stored. The stored nuisance is the change of the pretension with temperature
(`problem.Warming`), because the next calibration needs it.
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
    """Declaration of a nuisance. Each subclass defines the effects of one kind of nuisance.

    Attributes:
        name: Name of the nuisance.
        unit: Unit of the value of the nuisance.
        probabilities: Pairs of a standard deviation before the presses and its prior probability. Each standard
            deviation is considered as a hypothesis (see `hypotheses`). By default, only zero is considered.
        std_with_temperatures: Standard deviation before the presses if the temperatures of the presses are known; zero
            for a nuisance that does not depend on temperature.
    """

    name: str
    unit: str
    probabilities: tuple[tuple[float, float], ...] = ((0.0, 1.0),)
    std_with_temperatures: float = 0.0

    def charge_error(self, data: PressData, value: float) -> Array:
        """Return the charges that the nuisance adds to the measured charges. By default, they are zero.

        Args:
            data: The measured presses.
            value: Value of the nuisance.

        Returns:
            Added charges, shape (n, n_electrode), pC.
        """
        del value  # not used by a nuisance that adds no charge
        return np.zeros_like(data.charge)

    def tension_change(self, data: PressData, value: float) -> Array:
        """Return the change of the pretension that the nuisance causes during each press. By default, it is zero.

        Args:
            data: The measured presses.
            value: Value of the nuisance.

        Returns:
            Changes of the pretension, shape (n,), MPa.
        """
        del value  # not used by a nuisance that does not change the pretension
        return np.zeros(len(data))

    def gain_std(self, estimate: NuisanceEstimate) -> float:
        """Return the relative standard deviation that the nuisance adds to all gains for the later use of the film.

        By default, a nuisance does not affect the later use of the film.

        Args:
            estimate: Estimate of the nuisance.
        """
        del estimate  # not used by a nuisance without an effect on the later use
        return 0.0

    def caution(self, estimate: NuisanceEstimate) -> str:
        """Return a warning that the session probably has this nuisance.

        Args:
            estimate: Estimate of the nuisance.
        """
        return f"the session has {self.name}: {estimate.value:.2g} +- {estimate.std:.2g} {self.unit}; it is subtracted"


class PretensionPerKelvin(Nuisance):
    """Change of the pretension with temperature, which occurs because film and ring expand differently."""

    def tension_change(self, data: PressData, value: float) -> Array:
        """Return the pretension during each press minus the pretension at the mean temperature, shape (n,), MPa."""
        return value * data.warming_K


class PretensionPerFilmExcess(Nuisance):
    """Change of the pretension for each kelvin by which the film is warmer than its ring.

    If the film is warmer than its ring, the pretension decreases.
    """

    def tension_change(self, data: PressData, value: float) -> Array:
        """Return how much the pretension during each press differs from the mean pretension, shape (n,), MPa.

        The pretension changes with the excess, which is the temperature of the film minus the temperature of its ring.
        The mean pretension is the pretension for the mean excess of all presses.
        """
        return value * data.film_excess_K


class ChargeOffset(Nuisance):
    """Common offset of all charges, for example because of a wrong tare."""

    def charge_error(self, data: PressData, value: float) -> Array:
        """Return the offset as the error of every charge, shape (n, n_electrode), pC."""
        return np.full_like(data.charge, value)

    def caution(self, estimate: NuisanceEstimate) -> str:
        """Return a warning that the tare may be wrong."""
        return (
            f"the charges are {estimate.value:.2g} +- {estimate.std:.2g} pC too large in all presses and electrodes: "
            "is the tare right? The offset is subtracted"
        )


class ChargeDrift(Nuisance):
    """Relative drift of all charges during a session, for example because the gain of an amplifier changes."""

    def charge_error(self, data: PressData, value: float) -> Array:
        """Return the error of each charge that the drift causes, shape (n, n_electrode), pC.

        The relative error changes from minus half of the drift at the first press to plus half of the drift at the last
        press.
        """
        return value * data.session_time[:, None] * data.charge

    def gain_std(self, estimate: NuisanceEstimate) -> float:
        """Return the standard deviation of a uniform distribution with the width of the drift.

        All gains that occurred during the session are assumed to be equally probable at a later time.
        """
        return float(np.hypot(estimate.value, estimate.std) / np.sqrt(12.0))

    def caution(self, estimate: NuisanceEstimate) -> str:
        """Return a warning that the charges drift."""
        return (
            f"the charges are {100.0 * estimate.value:.2g} +- {100.0 * estimate.std:.2g} % larger at the end than at "
            "the beginning: does an amplifier drift? The drift is subtracted"
        )


class Friction(Nuisance):
    """Coefficient of friction between tip and film for presses with a vertical stage; see `side_forces`."""

    def charge_error(self, data: PressData, value: float) -> Array:
        """Return the charges that friction adds, shape (n, n_electrode), pC."""
        return value * data.friction_charge


PRETENSION_PER_KELVIN = PretensionPerKelvin("pretension_per_K", "MPa/K", std_with_temperatures=0.4)
"""Change of the pretension with temperature.

Its standard deviation before the presses is E da / (1 - nu), which is 0.3 to 0.44 MPa/K on aluminium.
"""

PRETENSION_PER_FILM_EXCESS = PretensionPerFilmExcess("pretension_per_film_K", "MPa/K", std_with_temperatures=0.6)
"""Change of the pretension per kelvin by which the film is warmer than its ring.

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
    """Yield a sentence on how the pretension changes if the film is warmer than its ring (generator).

    Nothing is yielded if the presses hardly determine this change.

    Args:
        estimates: Estimates of the nuisances by name.
    """
    estimate = estimates[PRETENSION_PER_FILM_EXCESS.name]
    # A standard deviation of zero means that the temperatures are unknown. The presses determine the change if they at
    # least halve its standard deviation.
    if 0.0 < estimate.std <= 0.5 * PRETENSION_PER_FILM_EXCESS.std_with_temperatures:
        yield (
            f"The pretension changes by {estimate.value:.3g} +- {estimate.std:.2g} MPa per kelvin that the film is "
            "warmer than its ring. The result holds for the mean difference of both temperatures."
        )


def without_nuisances(data: PressData, values: Sequence[float] | Array) -> PressData:
    """Subtract the charges of nuisances from measured presses, and set the change of the pretension during each press.

    Args:
        data: The presses as they were measured.
        values: Value of each nuisance, in the order of `NUISANCES`.

    Returns:
        A copy of the presses with corrected `charge` and with `tension_change`.
    """
    charge = data.charge
    tension_change = np.zeros(len(data))
    for nuisance, value in zip(NUISANCES, values, strict=True):
        charge = charge - nuisance.charge_error(data, value)
        tension_change = tension_change + nuisance.tension_change(data, value)
    return replace(data, charge=charge, tension_change=tension_change)


def nuisance_derivatives(data: PressData, pretension_derivative: Array) -> Array:
    """Compute the derivatives of the residuals with respect to the nuisances.

    The added charge, or the change of the pretension, is proportional to the value of the nuisance. Therefore, the
    derivatives are the effects of the value 1.

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
        effect_by_charge = np.column_stack([charge_derivative, rig_derivative])
        effect_by_pretension = pretension_derivative * nuisance.tension_change(data, 1.0)[:, None]
        derivatives.append(effect_by_charge + effect_by_pretension)
    return np.stack(derivatives, axis=2)
