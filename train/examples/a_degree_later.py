"""
What does a degree of room temperature do to a calibration?
===========================================================

A film expands more than its aluminium ring. If both become warmer by one kelvin, the pretension of a biaxial film
decreases by about 0.35 MPa. The calibrated model then computes wrong positions and forces. This example measures the
errors after 1 and 3 K, and corrects the model by a second calibration. Ordinary touches at unknown places are
sufficient for this calibration, because four charges contain one number more than the three unknowns of a contact. A
few presses at known places give smaller errors. The example also measures how many touches have a misfit above 5, for
which the records carry the flag ``misfit``.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from isocharge.serve import MeasuredPresses, Predictor
from isocharge.simulate import Circle, ForwardMap, load_sensor, noise_model
from isocharge.train import CalibrationProblem, CalibrationResult, calibrate, write_calibration
from isocharge.train.data.contact_errors import force_error_percent, position_error
from isocharge.train.data.presses import draw_contacts

CALIBRATED_PRETENSION_MPa = 1.5
CHANGE_PER_KELVIN_MPa = -0.35  # of the pretension, if film and ring become warmer by the same amount
MISFIT_LIMIT = 5.0  # of the flag `misfit`

problem = CalibrationProblem(load_sensor("four-25um-biaxial"), Circle(1.0))
prior = problem.prior.layout.prior
noise = noise_model("reference")
rng = np.random.default_rng(5)
film = prior.draw(rng, 1)[0]


def film_at(warming_K: float) -> ForwardMap:
    """Return the map from contacts to charges of the film after film and ring became warmer."""
    values = film.copy()
    values[prior.index("pretension")] = CALIBRATED_PRETENSION_MPa + warming_K * CHANGE_PER_KELVIN_MPa
    return ForwardMap.build(*prior.film(values))


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
    return calibrate(presses, replace(problem, earlier=calibration.film.drifted()))


def show_errors(label: str, folder: Path, forward_map: ForwardMap, line: str) -> None:
    """Print the errors of a calibrated model for 1000 new touches of a film, and plot the position errors.

    The line has a colour for each warming, and is dashed after an update by touches and dotted after one by presses.
    """
    contact, presses = touch(forward_map, 1000, is_known=True)
    answers = Predictor(folder).predict_batch(presses.charge_pC)
    estimate = np.column_stack([answers.x_mm, answers.y_mm, answers.force_N])
    distance = position_error(estimate, contact)
    force_error = force_error_percent(estimate, contact)
    print(
        f"{label}: position {np.sqrt(np.mean(distance**2)):.2f} mm rms, force {np.sqrt(np.mean(force_error**2)):.1f} % "
        f"rms, {np.mean(force_error):+.1f} % on average, misfit above {MISFIT_LIMIT:g} in "
        f"{100.0 * np.mean(answers.misfit > MISFIT_LIMIT):.1f} % of the touches"
    )
    plt.plot(np.sort(distance), np.linspace(0.0, 1.0, len(distance)), line, label=label)


as_calibrated, warmer_1_K, warmer_3_K = (film_at(warming_K) for warming_K in (0.0, 1.0, 3.0))
_, calibration_presses = touch(as_calibrated, 20, is_known=True)
calibration = calibrate(calibration_presses, problem)
_, unknown_touches_1_K = touch(warmer_1_K, 60, is_known=False)
_, unknown_touches_3_K = touch(warmer_3_K, 60, is_known=False)
_, known_presses_3_K = touch(warmer_3_K, 3, is_known=True)

with tempfile.TemporaryDirectory() as temporary:
    folder = Path(temporary)
    original = write_calibration(calibration, folder / "original")
    show_errors("as calibrated", original, as_calibrated, "k-")
    show_errors("1 K warmer", original, warmer_1_K, "C0-")
    show_errors("3 K warmer", original, warmer_3_K, "C3-")
    for label, presses, forward_map, line in (
        ("1 K warmer, after 60 touches", unknown_touches_1_K, warmer_1_K, "C0--"),
        ("3 K warmer, after 60 touches", unknown_touches_3_K, warmer_3_K, "C3--"),
        ("3 K warmer, after 3 known presses", known_presses_3_K, warmer_3_K, "C3:"),
    ):
        show_errors(label, write_calibration(update(presses), folder / "updated"), forward_map, line)

plt.gca().set(xlabel="position error, mm", ylabel="share of touches", xlim=(0.0, 2.5))
handles, labels = plt.gca().get_legend_handles_labels()
order = np.argsort(labels)  # 1 K, 3 K, as calibrated
plt.legend([handles[index] for index in order], [labels[index] for index in order])
plt.show()
