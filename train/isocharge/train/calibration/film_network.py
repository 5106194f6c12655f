"""Training of the network of a calibrated film.

The network learns from presses on films that are drawn from the posterior distribution of the calibrated film, with
noise. Its standard deviations therefore contain the noise and everything that is not known about the film.

The posterior distribution has many unknowns, of which only a few linear combinations change the charges. These
combinations are called directions. Each direction is a smooth relative change of the charges, which is described by a
series in the contact (`ChargeField`, `fit_series`).
"""

import hashlib
from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.chebyshev_series import Series
from isocharge.simulate import Domain, NoiseModel
from isocharge.simulate.forward.whole_film import outermost_distance, whole_film_map
from isocharge.simulate.solver.friction import MAX_FRICTION
from isocharge.simulate.solver.stress_limit import yield_force
from isocharge.train.calibration.discrepancy import terms
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.film_estimate import FilmEstimate
from isocharge.train.data.charge_field import ChargeField, fit_series
from isocharge.train.data.presses import LabelledPresses, draw_contacts
from isocharge.train.training.source import TrainingData

SERIES_CONTACTS = 5000
"""Number of contacts to which the series of the charges is fitted."""

DIRECTION_CONTACTS = 1200
"""Number of contacts to which the series of the directions are fitted."""

DIRECTION_DEGREES = (8, 3)
"""Degrees of the series of the directions in the position and in the force."""

MIN_DIRECTION = 0.1
"""Smallest root-mean-square effect of a direction on a charge, in standard deviations of the noise, that is kept."""

PRESSES = 60_000
"""Number of presses from which the network learns."""

OUTSIDE_PRESSES = 16_384
"""Number of presses outside the working area from which the network learns that they are outside."""

SEED = 3
"""Seed of the contacts and of the drawn films."""


@dataclass(frozen=True)
class SideForces:
    """Side forces of later contacts.

    Attributes:
        friction: Estimated coefficient of friction of the presses, and its standard deviation. Later contacts have this
            friction or none, each with the probability 0.5.
        share: Largest side force in any direction, relative to the force.
    """

    friction: tuple[float, float] = (0.0, 0.0)
    share: float = 0.0


@dataclass(frozen=True)
class CompactCharges:
    """Charges of a calibrated film and their uncertainty, as series in the contact.

    Attributes:
        field: Charges of the most probable film.
        directions: Series of the relative changes of the charges by one standard deviation of each direction. The last
            axis has n_direction * n_electrode entries.
        offset: Most probable offset of all charges and its standard deviation, pC.
    """

    field: ChargeField
    directions: Series
    offset: tuple[float, float]

    @classmethod
    def of(cls, charges: FilmCharges, film: FilmEstimate, domain: Domain, noise: NoiseModel) -> "CompactCharges":
        """Compute the series of an estimated film.

        Args:
            charges: Charges of the solved film and of similar films.
            film: The estimate.
            domain: Contacts for which the series are needed. It lies within the domain of `charges`.
            noise: Noise of the charges, which decides how many directions are needed.
        """
        rng = np.random.default_rng(SEED)
        contact = draw_contacts(rng, domain, SERIES_CONTACTS)
        charge = _film_charges(charges, film, contact)
        labelled = LabelledPresses(contact, charge)
        n_fitted = int(0.9 * len(contact))
        names = charges.prior.sensor.electrode_names
        field = ChargeField.fit(domain, names, labelled[:n_fitted], labelled[n_fitted:])

        contact = contact[:DIRECTION_CONTACTS]
        changes = _directions(charges, film, contact, noise)
        coefficients = fit_series(domain.to_unit(contact), changes.reshape(len(contact), -1), *DIRECTION_DEGREES)
        return cls(field, Series(coefficients), (film.value("offset"), film.std("offset")))

    def draw(self, rng: np.random.Generator, contact: Array, gain_std: float) -> Array:
        """Draw the charges of contacts, each on another film of the posterior distribution.

        Args:
            rng: Random number generator.
            contact: Contacts (x, y, F), shape (n, 3), mm and N.
            gain_std: Standard deviation of a common relative change of all charges.

        Returns:
            Charges without noise, shape (n, n_electrode), pC.
        """
        charge = self.field.charges(contact)
        unit_contact = self.field.domain.to_unit(contact)
        changes = self.directions.values_and_derivatives(unit_contact)[:, 0].reshape(len(contact), -1, charge.shape[1])
        deviations = rng.standard_normal(changes.shape[:2])
        log_change = np.einsum("nk,nke->ne", deviations, changes)
        log_change += gain_std * rng.standard_normal((len(contact), 1))
        offset, offset_std = self.offset
        return np.asarray(charge * np.exp(log_change) + offset + offset_std * rng.standard_normal((len(contact), 1)))


def _film_charges(charges: FilmCharges, film: FilmEstimate, contact: Array) -> Array:
    """Compute the most probable charges of contacts, with the discrepancy, without offset, shape (n, n_electrode)."""
    charge = charges.charges(film.film_values, contact)
    coefficients = film.values[film.layout.coefficients].reshape(-1, charge.shape[1])
    return np.asarray(charge * (1.0 + terms(contact, charges.domain) @ coefficients))


def _directions(charges: FilmCharges, film: FilmEstimate, contact: Array, noise: NoiseModel) -> Array:
    """Compute the relative changes of the charges along the directions that are larger than `MIN_DIRECTION`.

    Returns:
        Changes by one standard deviation of each direction, shape (n, n_direction, n_electrode), dimensionless.
    """
    layout = film.layout
    charge, jacobian = charges.linearised(film.film_values, contact)
    size = np.maximum(np.abs(charge), noise.white)
    relative_jacobian = jacobian / size[:, :, None]
    n_electrode = charge.shape[1]
    term_values = terms(contact, charges.domain)
    own = np.eye(n_electrode)[None, :, None, :] * term_values[:, None, :, None]
    relative_jacobian = np.concatenate([relative_jacobian, own.reshape(*charge.shape, -1)], axis=2)

    # Square root of the covariance of the film's properties and of the coefficients
    unknowns = np.r_[layout.film, layout.coefficients]
    eigenvalues, vectors = np.linalg.eigh(film.covariance[np.ix_(unknowns, unknowns)])
    root = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))
    changes = relative_jacobian @ root  # shape (n, n_electrode, n_unknown)

    # Rotate the directions so that they are uncorrelated in units of the noise, and keep the large ones.
    weight = (np.abs(charge) / noise.sigma(charge))[:, :, None]
    _, singular_values, rotation = np.linalg.svd((weight * changes).reshape(-1, changes.shape[2]), full_matrices=False)
    effect = singular_values / np.sqrt(charge.size)
    kept = rotation[effect > MIN_DIRECTION]
    return np.asarray((changes @ kept.T).swapaxes(1, 2))


def training_data(
    charges: FilmCharges,
    film: FilmEstimate,
    compact: CompactCharges,
    side_forces: SideForces,
    executor: Executor | None,
) -> TrainingData:
    """Draw the presses from which the network of a calibrated film learns.

    Args:
        charges: Charges of the solved film and of similar films.
        film: The estimate of the film.
        compact: The same charges as series.
        side_forces: Side forces of later contacts.
        executor: Executor that solves the presses outside the working area; None for this process.
    """
    rng = np.random.default_rng([SEED, 1])
    domain = compact.field.domain
    contact = draw_contacts(rng, domain, PRESSES)
    drift = np.hypot(film.value("drift"), film.std("drift"))
    charge = compact.draw(rng, contact, gain_std=float(drift / np.sqrt(12.0)))
    charge = charge + _side_charges(charges, side_forces, rng, contact)
    sensor, probe = charges.prior.film(film.film_values)
    return TrainingData(
        sensor=sensor,
        probes=(str(charges.prior.probe),),
        domain=domain,
        presses=LabelledPresses(contact, charge),
        sha256=hashlib.sha256(charge.tobytes()).hexdigest(),
        outside=_outside_presses(charges, domain, executor),
        yield_force_N=yield_force(sensor.film, [probe], domain.force_range),
        field=compact.field,
    )


def _side_charges(charges: FilmCharges, side_forces: SideForces, rng: np.random.Generator, contact: Array) -> Array:
    """Draw the charges that side forces of later contacts add, shape (n, n_electrode), pC.

    The effect of side forces is computed at a few contacts, and described by a series.
    """
    charge = np.zeros((len(contact), len(charges.prior.sensor.electrode_names)))
    side_force_map = charges.side_forces
    if side_force_map is None:
        return charge
    domain = charges.domain
    sample = draw_contacts(rng, domain, DIRECTION_CONTACTS)

    def series_of(values: Array) -> Array:
        """Fit a series to values at the sample, shape (n_sample, k), and return its values at the contacts."""
        series = Series(fit_series(domain.to_unit(sample), values, *DIRECTION_DEGREES))
        return series.values_and_derivatives(domain.to_unit(contact))[:, 0]

    coefficient, std = side_forces.friction
    if coefficient > 0.0:
        reference = min(coefficient, MAX_FRICTION)
        friction_charge = series_of(side_force_map.friction_charges(sample, reference) / reference)
        drawn = coefficient + std * rng.standard_normal(len(contact))
        has_friction = rng.random(len(contact)) < 0.5
        charge += (drawn * has_friction)[:, None] * friction_charge
    if side_forces.share > 0.0:
        jacobian = series_of(side_force_map.jacobian(sample).reshape(len(sample), -1)).reshape(*charge.shape, 2)
        angle = 2.0 * np.pi * rng.random(len(contact))
        direction = np.column_stack([np.cos(angle), np.sin(angle)])
        charge += side_forces.share * contact[:, 2:] * np.einsum("nek,nk->ne", jacobian, direction)
    return charge


def _outside_presses(charges: FilmCharges, domain: Domain, executor: Executor | None) -> LabelledPresses | None:
    """Solve presses between the working area and the clamp, on the axisymmetric film under the circular probe.

    They only teach the network which charges belong to no contact, so that the imperfections do not matter.
    """
    round_map = charges.slopes.film
    outermost = outermost_distance(round_map.sensor.film, round_map.probe)
    if outermost <= domain.radius:
        return None
    whole_map = whole_film_map(round_map.sensor, round_map.probe, domain.force_range, executor=executor)
    rng = np.random.default_rng([SEED, 2])
    contact = draw_contacts(rng, replace(domain, radius=outermost), 4 * OUTSIDE_PRESSES)
    is_outside = np.hypot(contact[:, 0], contact[:, 1]) > domain.radius
    contact = contact[is_outside][:OUTSIDE_PRESSES]
    return LabelledPresses(contact, whole_map.charges(contact))
