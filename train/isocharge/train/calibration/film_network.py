"""Presses from which the network of a calibrated film learns.

The presses are made, with noise, on films that are drawn from the posterior distribution of the calibration. The
standard deviations of the network therefore include the effects of the noise and of everything that is not known about
the film.
"""

from concurrent.futures import Executor

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.files import sha256_of
from isocharge.serve.model.charge_series import CHUNK_SIZE, ChargeSeries
from isocharge.simulate import Domain, Sweep
from isocharge.simulate.forward.whole_film import outermost_distance, whole_film_map
from isocharge.simulate.solver.stress_limit import yield_force
from isocharge.train.calibration.compact_map import SEED
from isocharge.train.calibration.film_charges import FilmCharges
from isocharge.train.calibration.film_estimate import FilmEstimate
from isocharge.train.data.presses import LabelledPresses, draw_contacts
from isocharge.train.training.training_data import TrainingData

N_PRESSES = 60_000
"""Number of presses from which the network learns."""


def training_data(
    charges: FilmCharges, film: FilmEstimate, series: ChargeSeries, executor: Executor | None
) -> TrainingData:
    """Draw the presses from which the network of a calibrated film learns.

    Each press is made on another film, which is drawn from the posterior distribution of the calibrated film. The
    compact charge map gives the charges of these films.

    Args:
        charges: Charges of the solved film and of similar films.
        film: The estimate of the film.
        series: The compact charge map of the film.
        executor: Executor that solves the presses outside the working area; None for this process.

    Returns:
        The presses inside and outside the working area, with the sensor, the probe and the force at which the film
        yields.
    """
    rng = np.random.default_rng([SEED, 1])
    domain = series.domain
    contact = draw_contacts(rng, domain, N_PRESSES)
    charge = _drawn_charges(series, rng, contact)  # each on its own film, shape (N_PRESSES, n_electrode), pC

    # The property "drift" is the relative change of the gain during the session of measured presses. The film is
    # estimated for the middle of the session. After the session, the gain therefore differs from the estimate by half
    # of the drift, and may change further or return. One gain error is drawn for each press.
    drift_rms = np.hypot(film.value("drift"), film.std("drift"))
    gain_error = 0.5 * drift_rms * rng.standard_normal((N_PRESSES, 1))
    charge *= 1.0 + gain_error

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
    """Compute the charges of contacts, each on a film of its own that is drawn from the posterior distribution.

    Args:
        series: The compact charge map of the film, which can be evaluated for similar films.
        rng: Random number generator.
        contact: Contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        Charges, shape (n, n_electrode), pC.
    """
    drawn = []
    for chunk in np.array_split(contact, len(contact) // CHUNK_SIZE + 1):  # chunks limit the memory
        # The state of a film is the change of its pretension and its deviations along the directions. The directions
        # are the linear combinations of the unknowns that change the charges, scaled to the standard deviation 1.
        state = rng.standard_normal((len(chunk), 1 + series.direction_count))
        state[:, 0] = 0.0  # the pretension does not change
        drawn.append(series.in_state(chunk, state).charge_pC)
    return np.concatenate(drawn)


def _outside_presses(charges: FilmCharges, domain: Domain, executor: Executor | None) -> LabelledPresses | None:
    """Solve presses between the working area and the clamp.

    From these presses, the network only learns which charges belong to no contact. The imperfections of the film hardly
    matter for this purpose, so the presses are solved on the axisymmetric film without imperfections, under a circular
    probe.

    Args:
        charges: Charges of the solved film, which contain the map of the axisymmetric film.
        domain: The working area and the range of forces.
        executor: Executor that runs the solves; None for this process.

    Returns:
        The presses; None if there is no room for presses outside the working area.
    """
    axisymmetric_map = charges.slopes.film  # forward map from contacts to charges, with its sensor and its probe
    # The probe reaches farthest under the largest force.
    outermost_mm = outermost_distance(axisymmetric_map.sensor.film, axisymmetric_map.probe.under(domain.force_range[1]))
    if outermost_mm <= domain.radius:
        return None
    # The map of the calibration covers little more than the working area. Solve presses on nearly the whole film.
    whole_map = whole_film_map(axisymmetric_map.sensor, axisymmetric_map.probe, domain.force_range, executor=executor)
    contact = Sweep(domain.radius, domain.force_range, seed=SEED).outside_presses(outermost_mm).contact
    return LabelledPresses(contact, whole_map.charges(contact))
