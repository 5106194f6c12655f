"""
What does a degree of room temperature do to a calibration?
===========================================================

A film expands more than its aluminium ring. If both become warmer by one kelvin, the pretension of a biaxial film
decreases by about 0.35 MPa. The calibrated model then computes wrong positions and forces. This example measures the
errors after 1, 2 and 3 K, and corrects the model by a second calibration. Ordinary touches at unknown places are
sufficient for this calibration, because four charges contain one number more than the three unknowns of a contact. A
few presses at known places give smaller errors. The example also measures how many touches have a misfit above 5, for
which the records carry the flag ``misfit``.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from isocharge.common.contact_errors import force_error_percent, position_error
from isocharge.serve import MeasuredPresses
from isocharge.simulate import Circle, ForwardMap, load_sensor, noise_model
from isocharge.train import CalibrationProblem, CalibrationResult, calibrate
from isocharge.train.data.presses import draw_contacts

CALIBRATED_PRETENSION_MPa = 1.5
CHANGE_PER_KELVIN_MPa = -0.35  # of the pretension, if film and ring become warmer by the same amount
MISFIT_LIMIT = 5.0  # of the flag `misfit`

problem = CalibrationProblem.of(load_sensor("four-25um-biaxial"), Circle(1.0))
noise = noise_model("reference")
rng = np.random.default_rng(5)
film = problem.prior.draw(rng, 1)[0]


def film_at(warming_K: float) -> ForwardMap:
    """Return the map from contacts to charges of the film after film and ring became warmer."""
    parameters = film.copy()
    parameters[problem.prior.index("pretension")] = CALIBRATED_PRETENSION_MPa + warming_K * CHANGE_PER_KELVIN_MPa
    return problem.charges.forward_map(parameters)


def touch(forward_map: ForwardMap, count: int, *, is_known: bool) -> tuple[np.ndarray, MeasuredPresses]:
    """Simulate touches of a film.

    Args:
        forward_map: Map from contacts to charges of the film.
        count: Number of touches.
        is_known: Whether the place (to 0.1 mm) and the force (to 1 %) of the touches are known.

    Returns:
        The true contacts (x, y, force), shape (count, 3), mm and N, and the touches as measured presses.
    """
    contact = draw_contacts(rng, problem.domain, count)
    charge = noise.add(forward_map.charges(contact), rng)
    known_contact = contact if is_known else np.full_like(contact, np.nan)
    position_std, force_std = np.full(count, 0.1), np.full(count, 0.01)
    lines = tuple(range(1, count + 1))
    return contact, MeasuredPresses(known_contact, charge, position_std, force_std, problem.electrodes, lines)


def update(presses: MeasuredPresses) -> CalibrationResult:
    """Calibrate the film again. Its pretension may have changed since the first calibration."""
    return calibrate(presses, replace(problem, earlier=calibration.posterior.drifted(problem.prior)))


def show_errors(label: str, result: CalibrationResult, forward_map: ForwardMap, line: str) -> None:
    """Print the errors of a calibrated model for 1000 new touches of a film, and plot the position errors.

    The line has a colour for each warming, and is dashed after an update by touches and dotted after one by presses.
    """
    contact, presses = touch(forward_map, 1000, is_known=True)
    estimate, _, misfit = result.fitted.predict(presses.charge_pC)
    distance = position_error(estimate, contact)
    force_error = force_error_percent(estimate, contact)
    print(
        f"{label}: model for {result.film[0].film.pretension:.2f} MPa, position {np.sqrt(np.mean(distance**2)):.2f} mm "
        f"rms, force {np.sqrt(np.mean(force_error**2)):.1f} % rms, {np.mean(force_error):+.1f} % on average, misfit "
        f"above {MISFIT_LIMIT:g} in {100.0 * np.mean(misfit > MISFIT_LIMIT):.1f} % of the touches"
    )
    plt.plot(np.sort(distance), np.linspace(0.0, 1.0, len(distance)), line, label=label)


as_calibrated, warmer_1_K, warmer_2_K, warmer_3_K = (film_at(warming_K) for warming_K in (0.0, 1.0, 2.0, 3.0))
_, calibration_presses = touch(as_calibrated, 20, is_known=True)
calibration = calibrate(calibration_presses, problem)
_, unknown_touches_1_K = touch(warmer_1_K, 60, is_known=False)
_, unknown_touches_3_K = touch(warmer_3_K, 60, is_known=False)
_, known_presses_3_K = touch(warmer_3_K, 3, is_known=True)

show_errors("as calibrated", calibration, as_calibrated, "k-")
show_errors("1 K warmer", calibration, warmer_1_K, "C0-")
show_errors("1 K warmer, after 60 touches", update(unknown_touches_1_K), warmer_1_K, "C0--")
show_errors("3 K warmer", calibration, warmer_3_K, "C3-")
show_errors("3 K warmer, after 60 touches", update(unknown_touches_3_K), warmer_3_K, "C3--")
show_errors("3 K warmer, after 3 known presses", update(known_presses_3_K), warmer_3_K, "C3:")

_, unknown_touches_2_K = touch(warmer_2_K, 60, is_known=False)
_, known_presses_2_K = touch(warmer_2_K, 3, is_known=True)
show_errors("2 K warmer", calibration, warmer_2_K, "C1-")
show_errors("2 K warmer, after 60 touches", update(unknown_touches_2_K), warmer_2_K, "C1--")
show_errors("2 K warmer, after 3 known presses", update(known_presses_2_K), warmer_2_K, "C1:")

plt.gca().set(xlabel="position error, mm", ylabel="share of touches", xlim=(0.0, 2.5))
handles, labels = plt.gca().get_legend_handles_labels()
order = np.argsort(labels)  # 1 K, 2 K, 3 K, as calibrated
plt.legend([handles[index] for index in order], [labels[index] for index in order])
plt.show()
