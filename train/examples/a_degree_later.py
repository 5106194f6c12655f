"""
What does a degree of room temperature do to a calibration?
===========================================================

An aluminium ring and the film expand differently, so one degree pulls the film by 0.35 MPa: a calibrated model is
then off by some tenths of a millimetre. Ordinary touches, whose place and force nobody knows, bring it back: four
charges have one number to spare.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

from isocharge.common.contact_errors import position_error
from isocharge.serve import MeasuredPresses
from isocharge.simulate import Circle, load_sensor, noise_model
from isocharge.train import CalibrationProblem, calibrate
from isocharge.train.data.presses import draw_contacts

problem = CalibrationProblem.of(load_sensor("four-25um-biaxial"), Circle(1.0))
noise = noise_model("reference")
rng = np.random.default_rng(5)
pretension = problem.prior.names.index("pretension")
film = problem.prior.draw(rng, 1)[0]
film[pretension] = 1.0  # MPa
warm = np.where(np.arange(film.size) == pretension, film + 0.35, film)
morning, later = (problem.charges.forward_map(parameters) for parameters in (film, warm))


def touch(forward_map, count, known):
    """Touches of a film: place to 0.1 mm and force to 1 %, or neither."""
    contact = draw_contacts(rng, problem.domain, count)
    charge = noise.add(forward_map.charges(contact), rng)
    read = contact if known else np.full_like(contact, np.nan)
    stds = np.full(count, 0.1), np.full(count, 0.01)
    return contact, MeasuredPresses(read, charge, *stds, problem.electrodes, tuple(range(1, count + 1)))


calibrated = calibrate(touch(morning, 20, known=True)[1], problem)
earlier = replace(problem, earlier=calibrated.posterior.drifted(problem.prior))
followed = calibrate(touch(later, 60, known=False)[1], earlier)
cases = {
    "calibrated": (calibrated, morning),
    "a degree later": (calibrated, later),
    "after 60 touches": (followed, later),
}
for label, (result, now) in cases.items():
    contact, presses = touch(now, 1000, known=True)
    error = position_error(result.fitted.predict(presses.charge_pC)[0], contact)
    print(f"{label}: {result.film[0].film.pretension:.2f} MPa, {np.sqrt(np.mean(error**2)):.2f} mm rms")
    plt.plot(np.sort(error), np.linspace(0.0, 1.0, len(error)), label=label)
plt.gca().set(xlabel="position error, mm", ylabel="share of touches", xlim=(0.0, 1.5))
plt.legend()
plt.show()
