"""Bayes limit, which is the error of the posterior mean.

No estimator has a smaller mean squared error than the posterior mean. The limit depends on the film, the probe, the
noise and the range of presses.

Example:
    problem = BayesProblem(load_sensor("three-25um-biaxial"), Circle(1.0), radius=8.0, force_range=(0.05, 2.0))
    contact, std = bayes_estimate(problem, charge)
"""

from dataclasses import dataclass, field

from bayes.posterior import Posterior

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.simulate import ChargeSpline, ForwardMap, NoiseModel, Probe, Sensor, noise_model


@dataclass(frozen=True)
class BayesProblem:
    """Conditions on which the Bayes limit depends.

    Attributes:
        sensor: The sensor.
        probe: Probe with its orientation.
        radius: Radius of the working area, mm, over which the positions are uniformly distributed.
        force_range: Smallest and largest force, N, between which the forces are log-uniform.
        noise: Noise of the charges.
    """

    sensor: Sensor
    probe: Probe
    radius: float = DEFAULT_RADIUS
    force_range: tuple[float, float] = DEFAULT_FORCE_RANGE
    noise: NoiseModel = field(default_factory=lambda: noise_model("reference"))

    def forward_map(self) -> ForwardMap:
        """Simulate the map from contacts to charges."""
        return ForwardMap.build(self.sensor, self.probe, self.radius, self.force_range)


def bayes_estimate(
    problem: BayesProblem, charge: Array, *, charge_map: ForwardMap | None = None
) -> tuple[Array, Array]:
    """Compute the posterior mean of the contact of each press from its noisy charges.

    The prior of the contact is uniform over the disk of the problem and in the logarithm of the force. The computation
    takes roughly 20 ms for each press.

    Args:
        problem: Sensor, probe, prior and noise.
        charge: Touch charges with noise, shape (n, n_electrode), pC.
        charge_map: Map from contacts to charges with the forces of the problem; None to simulate this map.

    Returns:
        Posterior means (x, y, F), shape (n, 3), and posterior standard deviations, shape (n, 3), mm and N. Instead of
        the mean of the force, E[1/F] / E[1/F^2] is returned, which has the smallest mean squared relative error.

    Raises:
        ChargeError: If a charge is not finite, or if the number of electrodes is wrong.
        InputError: If the noise is zero.
    """
    spline = ChargeSpline.of(charge_map or problem.forward_map())  # far faster than the map itself
    return Posterior(spline, problem.noise, problem.radius).mean_and_std(charge)
