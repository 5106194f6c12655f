"""
Do the charges show which probe touches the film?
=================================================

Four charges sometimes show that another probe presses. This example compares presses of a circle of 2 mm and of a
triangle of 4 mm with presses of a circle of 1 mm. About half of the presses differ from every press of the circle of
1 mm by more than three standard deviations of the noise. The other half cannot be distinguished from presses of the
circle of 1 mm. If the circle of 1 mm is assumed for all presses, the median position error is less than 0.1 mm.
"""

import matplotlib.pyplot as plt
import numpy as np

from isocharge.simulate import ChargeSpline, Circle, Domain, ForwardMap, Sweep, load_sensor, noise_model, parse_probe
from isocharge.simulate.identifiability.nearest_contact import explain

sensor = load_sensor("four-25um-uniaxial")
noise = noise_model("reference")
force = 1.0
domain = Domain(6.0, (force / 1.3, force * 1.3))  # another probe needs another force
circle = ChargeSpline.of(ForwardMap.build(sensor, Circle(1.0), domain.radius, domain.force_range))
contact = Sweep(domain.radius, (force, force), samples=1000).contacts()

figure, (differences, errors) = plt.subplots(1, 2, figsize=(11.0, 4.4), layout="constrained")
for notation in ("circle:0.5", "circle:2.0", "triangle:4.0"):
    charge = ForwardMap.build(sensor, parse_probe(notation), domain.radius, domain.force_range).charges(contact)
    explaining, residual = explain(circle, charge, noise.sigma(charge), contact)
    sigmas = np.linalg.norm(residual, axis=1)
    error = np.hypot(*(explaining - contact)[:, :2].T)
    print(
        f"{notation}: {100 * np.mean(sigmas > 3.0):.0f} % of the presses are distinguished; median position error "
        f"{np.median(error):.3f} mm"
    )
    for axes, values in ((differences, sigmas), (errors, error)):
        axes.plot(np.sort(values), np.linspace(0.0, 1.0, len(values)), label=notation)
differences.axvline(3.0, color="k", ls=":")
differences.set(xscale="log", xlabel="difference from a circle of 1 mm, standard deviations", ylabel="share of presses")
errors.set(xscale="log", xlabel="position error if a circle of 1 mm is assumed, mm")
errors.legend()
plt.show()
