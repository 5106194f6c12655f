"""Charge map and training data of a calibrated film.

The network of a calibrated film learns from presses on films that are drawn from the posterior distribution, with
noise. Its standard deviations therefore contain the noise and everything that is not known about the film.

The posterior distribution has many unknowns, of which only a few linear combinations change the charges. These
combinations are the directions of the compact charge map (`ChargeSeries`), from which both the training and the live
follower know what is uncertain. The nodes of the map are films with other pretensions. Their charges are those of the
calibrated film, times the ratio of the charges of nearly axisymmetric films with both pretensions.
"""

import logging
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.files import sha256_of
from isocharge.serve.model.charge_series import CHUNK_SIZE, ChargeSeries, series_size
from isocharge.serve.presses.measured_presses import CONTACT
from isocharge.simulate import Domain, FilmSlopes, Sweep
from isocharge.simulate.forward.whole_film import outermost_distance, whole_film_map
from isocharge.simulate.sensor.film_properties import PRETENSION, UNEVEN_TENSIONS
from isocharge.simulate.solver.stress_limit import yield_force
from isocharge.train.calibration.film_charges import FilmCharges, solve_even_map
from isocharge.train.calibration.film_estimate import FilmEstimate, discrepancy_jacobian
from isocharge.train.data.charge_fit import fit_film_series, fit_series
from isocharge.train.data.presses import LabelledPresses, draw_contacts
from isocharge.train.training.training_data import TrainingData

log = logging.getLogger(__name__)

SERIES_CONTACTS = 4000
"""Number of contacts to which the series of the charges are fitted."""

DIRECTION_CONTACTS = 1200
"""Number of contacts to which the series of the directions are fitted."""

DIRECTION_DEGREES = (8, 3)
"""Degrees of the series of the directions in the position and in the force."""

MIN_DIRECTION = 0.1
"""Smallest root-mean-square effect of a direction on a charge, in standard deviations of the noise, that is kept."""

MAX_SERIES_ERROR = 0.03
"""Largest relative error of the charges at all nodes. If it is larger, the outermost node is left out."""

NODES_MPa = (-0.7, -0.3, 0.0, 0.4, 0.9)
"""Changes of the pretension at the nodes of a film that can be followed, MPa.

The negative changes are smaller for a film that they would make slack."""

PRESSES = 60_000
"""Number of presses from which the network learns."""

SEED = 3
"""Seed of the contacts and of the drawn films."""


def compact_charges(
    domain: Domain, charges: FilmCharges, film: FilmEstimate, executor: Executor | None
) -> ChargeSeries:
    """Compute the compact charge map of an estimated film.

    Args:
        domain: Contacts for which the map is needed.
        charges: Charges of the solved film and of similar films.
        film: The estimate, with the noise of the charges, which decides how many directions are needed.
        executor: Executor that solves the films at the nodes; None for this process.
    """
    contact = draw_contacts(np.random.default_rng(SEED), domain, SERIES_CONTACTS)
    film_charge = charges.charges(film.film_values, contact)
    discrepancy = discrepancy_jacobian(film_charge, contact, charges.domain) @ film.values[film.layout.coefficients]
    charge = film_charge + discrepancy  # most probable charges without offset, shape (n, n_electrode)
    names = charges.prior.sensor.electrode_names
    node_MPa = np.zeros(1)
    node_charge = charge[:, None]
    if len(names) > len(CONTACT):  # three charges only determine the contact
        node_MPa = _nodes(film)
        node_charge = node_charge * _tension_factors(charges, film, contact, node_MPa, executor)
    series = _fit_followable_nodes(domain, names, contact, node_charge, node_MPa)
    few_contacts = slice(DIRECTION_CONTACTS)
    changes = _directions(charges, film, contact[few_contacts], charge[few_contacts])
    return replace(
        series,
        directions=_fit_directions(series, contact[few_contacts], charge[few_contacts], changes),
        # A film is at most as well described as its charges can be measured.
        charge_std=max(series.charge_std, film.noise.gain),
        offset_pC=film.value("offset"),
        pretension_MPa=film.value(PRETENSION.name),
        tension_std_MPa=PRETENSION.drift,
    )


def _fit_followable_nodes(
    domain: Domain, electrodes: tuple[str, ...], contact: Array, charge: Array, node_MPa: Array
) -> ChargeSeries:
    """Fit the charges at the nodes, and leave out outermost nodes until the relative error is small enough.

    At a distant node, the imperfections may nearly cancel a charge. Their first-order effect is then not accurate. A
    warning is logged for each change of the nodes.

    Args:
        domain: Contacts for which the series is needed.
        electrodes: Names of the electrodes.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        charge: Their charges at the nodes, shape (n, n_node, n_electrode), pC.
        node_MPa: Changes of the pretension at the nodes, shape (n_node,), MPa.
    """
    series = fit_film_series(domain, electrodes, contact, charge, node_MPa)
    if series.charge_std <= MAX_SERIES_ERROR or node_MPa.size == 1:
        return series
    is_nearer = np.abs(node_MPa) < np.abs(node_MPa).max()
    remaining_MPa = node_MPa[is_nearer]
    log.warning(
        "the charges of this film are not known after large changes of its pretension; changes from %+.2g to "
        "%+.2g MPa can be followed",
        remaining_MPa[0],
        remaining_MPa[-1],
    )
    return _fit_followable_nodes(domain, electrodes, contact, charge[:, is_nearer], remaining_MPa)


def _fit_directions(series: ChargeSeries, contact: Array, charge: Array, changes: Array) -> Array:
    """Fit polynomials to the effects of the directions, in which the charges are uncertain.

    A charge map contains values v instead of charges. If v is the logarithm of the charge, a small change of the charge
    divided by the charge is the change of v. Otherwise, v is the charge divided by the typical size of the charges at
    the same force.

    Args:
        series: Map of the charges without directions.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        charge: Their charges, shape (n, n_electrode), pC.
        changes: Changes of the charges by each direction, shape (n, n_direction, n_electrode), pC.

    Returns:
        Coefficients, as in `ChargeSeries.directions`.
    """
    unit_contact = series.domain.to_unit(contact)
    charge_per_value = charge if series.log_size is None else series_size(series.log_size, unit_contact[:, 2])[0]
    value_changes = changes / charge_per_value[:, None]
    coefficients = fit_series(unit_contact, value_changes.reshape(len(contact), -1), *DIRECTION_DEGREES)
    return coefficients.reshape(*coefficients.shape[:3], *changes.shape[1:])


def _nodes(film: FilmEstimate) -> Array:
    """Return the changes of the pretension at the nodes, of which none makes the film slack, shape (n_node,), MPa."""
    node_MPa = np.array(NODES_MPa)
    sensor, _ = film.layout.prior.film(film.film_values)
    lowest_MPa = -0.95 * (sensor.film.pretension - np.hypot(*sensor.film.deviator))
    factor = min(1.0, lowest_MPa / node_MPa.min())
    return np.unique(np.where(node_MPa < 0.0, factor * node_MPa, node_MPa))


def _tension_factors(
    charges: FilmCharges, film: FilmEstimate, contact: Array, node_MPa: Array, executor: Executor | None
) -> Array:
    """Compute the factors by which changes of the pretension multiply the charges.

    The tension changes equally in all directions. For each change, an axisymmetric film under a circular probe is
    solved, and the imperfections of an uneven film are added as first-order changes. If a change reverses the sign of a
    charge, no factor can describe it, and the result is 1.

    Args:
        charges: Charges of the solved film and of similar films.
        film: The estimate.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        node_MPa: Changes of the pretension, shape (n_node,), MPa.
        executor: Executor that solves the films; None for this process.

    Returns:
        Factors, shape (n, n_node, n_electrode), dimensionless.
    """
    prior = charges.prior
    mean_tension = film.layout.index(PRETENSION.name)
    uneven_tensions = [film.layout.index(name) for name in UNEVEN_TENSIONS]

    def charges_after(change_MPa: float) -> Array:
        """Solve the film after an equal change of its tension in all directions, and return its charges."""
        values = film.film_values.copy()
        values[mean_tension] += change_MPa
        # The values contain the uneven parts of the tension as shares of the mean tension. In MPa, they do not change.
        values[uneven_tensions] *= film.values[mean_tension] / values[mean_tension]
        even_map = solve_even_map(prior, values, charges.domain, executor)
        is_even = charges.film.sensor.film.is_axisymmetric
        if is_even:
            return even_map.charges(contact)
        slopes = FilmSlopes.build(even_map, executor=executor)
        # The values contain the same radius of the probe, so that its derivatives are not needed.
        similar_films = FilmCharges(prior, prior.even(values), even_map, slopes, larger_probe=None)
        return similar_films.charges(values, contact)

    charge = np.stack([charges_after(change_MPa) for change_MPa in node_MPa], axis=1)
    charge_before = charge[:, node_MPa == 0.0]
    return np.divide(charge, charge_before, out=np.ones_like(charge), where=charge_before * charge > 0.0)


def _directions(charges: FilmCharges, film: FilmEstimate, contact: Array, charge: Array) -> Array:
    """Compute the directions in which the charges are uncertain, and omit effects below `MIN_DIRECTION`.

    Args:
        charges: Charges of the solved film and of similar films.
        film: The estimate.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        charge: Their most probable charges, shape (n, n_electrode), pC.

    Returns:
        Changes by one standard deviation of each direction, shape (n, n_direction, n_electrode), pC.
    """
    layout = film.layout
    *_, film_jacobian = charges.linearised(film.film_values, contact)
    jacobian = np.concatenate([film_jacobian, discrepancy_jacobian(charge, contact, charges.domain)], axis=2)

    # Square root of the covariance of the film's properties and of the coefficients
    unknowns = np.r_[layout.film, layout.coefficients]
    eigenvalues, vectors = np.linalg.eigh(film.covariance[np.ix_(unknowns, unknowns)])
    changes = jacobian @ (vectors * np.sqrt(np.maximum(eigenvalues, 0.0)))  # shape (n, n_electrode, n_unknown)

    # Rotate the directions so that their effects are uncorrelated in units of the noise, and keep the large ones.
    weighted = (changes / film.noise.sigma(charge)[:, :, None]).reshape(-1, changes.shape[2])
    _, singular_values, rotation = np.linalg.svd(weighted, full_matrices=False)
    kept = rotation[singular_values > MIN_DIRECTION * np.sqrt(charge.size)]
    return np.asarray((changes @ kept.T).swapaxes(1, 2))


def training_data(
    charges: FilmCharges, film: FilmEstimate, series: ChargeSeries, executor: Executor | None
) -> TrainingData:
    """Draw the presses from which the network of a calibrated film learns.

    Args:
        charges: Charges of the solved film and of similar films.
        film: The estimate of the film.
        series: The compact charge map of the film.
        executor: Executor that solves the presses outside the working area; None for this process.
    """
    rng = np.random.default_rng([SEED, 1])
    domain = series.domain
    contact = draw_contacts(rng, domain, PRESSES)
    charge = _drawn_charges(series, rng, contact)
    # During the session, the gain changed linearly by the drift. The gains of the presses are therefore uniformly
    # distributed over an interval of this width, which has the standard deviation drift / sqrt(12). The drift itself is
    # uncertain: its root mean square follows from its estimate and its standard deviation.
    drift_rms = np.hypot(film.value("drift"), film.std("drift"))
    gain_std = drift_rms / np.sqrt(12.0)
    charge = charge * (1.0 + gain_std * rng.standard_normal((PRESSES, 1)))
    charge = charge + film.std("offset") * rng.standard_normal((PRESSES, 1))
    sensor, probe = charges.prior.film(film.film_values)
    return TrainingData(
        sensor=sensor,
        probes=(charges.prior.probe.rotated_notation,),
        domain=domain,
        presses=LabelledPresses(contact, charge),
        sha256=sha256_of(charge.tobytes()),
        outside=_outside_presses(charges, domain, executor),
        yield_force_N=yield_force(sensor.film, [probe], domain.force_range),
        field=series,  # the training uses the charges of the calibrated film
    )


def _drawn_charges(series: ChargeSeries, rng: np.random.Generator, contact: Array) -> Array:
    """Draw the charges of contacts, each on another film of the posterior distribution, shape (n, n_electrode), pC."""
    drawn = []
    for chunk in np.array_split(contact, len(contact) // CHUNK_SIZE + 1):
        state = rng.standard_normal((len(chunk), 1 + series.direction_count))
        state[:, 0] = 0.0  # the pretension does not change
        drawn.append(series.in_state(chunk, state).charge_pC)
    return np.concatenate(drawn)


def _outside_presses(charges: FilmCharges, domain: Domain, executor: Executor | None) -> LabelledPresses | None:
    """Solve presses between the working area and the clamp, on the axisymmetric film under the circular probe.

    They only teach the network which charges belong to no contact, so that the imperfections do not matter.
    """
    round_map = charges.slopes.film
    outermost = outermost_distance(round_map.sensor.film, round_map.probe.under(domain.force_range[1]))
    if outermost <= domain.radius:
        return None
    whole_map = whole_film_map(round_map.sensor, round_map.probe, domain.force_range, executor=executor)
    contact = Sweep(domain.radius, domain.force_range, seed=SEED).outside_presses(outermost).contact
    return LabelledPresses(contact, whole_map.charges(contact))
