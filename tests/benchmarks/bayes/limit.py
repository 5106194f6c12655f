"""Bayes limit, which is the error of the posterior mean.

No estimator has a smaller mean squared error than the posterior mean. The limit depends on the film, the probe, the
noise and the range of presses.

Example:
    problem = BayesProblem(load_sensor("three-25um-biaxial"), Circle(1.0), radius=8.0, force_range=(0.05, 2.0))
    contact, std = bayes_estimate(problem, charge)
"""

from concurrent.futures import Executor
from dataclasses import dataclass, field

from bayes.posterior import Posterior

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import InputError
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

    def forward_map(self, executor: Executor | None = None) -> ForwardMap:
        """Simulate the map from contacts to charges.

        Args:
            executor: Executor for the solves; None for this process.
        """
        return ForwardMap.build(self.sensor, self.probe, self.radius, self.force_range, executor=executor)


def bayes_estimate(
    problem: BayesProblem,
    charge: Array,
    *,
    charge_map: ForwardMap | ChargeSpline | None = None,
    executor: Executor | None = None,
) -> tuple[Array, Array]:
    """Compute the posterior mean of the contact of each press from its noisy charges.

    The prior of the contact is uniform over the disk of the problem and in the logarithm of the force. The computation
    takes roughly ten milliseconds for each press.

    Args:
        problem: Sensor, probe, prior and noise.
        charge: Touch charges with noise, shape (n, n_electrode), pC.
        charge_map: Map from contacts to charges; None to simulate this map. The range of forces of the map must be
            equal to that of the problem, and the radius of the map must be at least that of the problem.
        executor: Executor for the solves and integrals; None for this process.

    Returns:
        Posterior means (x, y, F), shape (n, 3), and posterior standard deviations, shape (n, 3), mm and N. Instead of
        the mean of the force, E[1/F] / E[1/F^2] is returned, which has the smallest mean squared relative error.

    Raises:
        ChargeError: If there are no charges, if a charge is not finite, or if the number of electrodes is wrong.
        InputError: If the noise is zero, or if the map has another range of forces or a smaller radius.
    """
    used_map = charge_map or problem.forward_map(executor)
    map_forces = used_map.domain.force_range
    if map_forces != problem.force_range:  # the posterior integrates over all forces of the map
        raise InputError(f"forces of the map: expected the problem's, {problem.force_range} N, got {map_forces} N")

    # The integration evaluates the charges at many contacts, which is much faster with a spline of the map.
    spline = used_map if isinstance(used_map, ChargeSpline) else ChargeSpline.of(used_map)
    posterior = Posterior(spline, problem.noise, problem.radius)  # raises an error for zero noise or a small map
    return posterior.mean_and_std(charge, executor)
