"""The Bayes limit: the errors of the posterior mean, which no estimator of x, y, F can beat on average.

    problem = BayesProblem(load_sensor("three-25um-biaxial"), Circle(1.0), radius=8.0, force_range=(0.05, 2.0))
    print(bayes_limit(problem).position_rms_mm)

It depends on the film, the probe, the noise and the range of presses.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, field

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import InputError
from isocharge.simulate import ChargeSpline, ForwardMap, NoiseModel, Probe, Sensor, Sweep, noise_model
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.bayes.posterior import Posterior

PRESSES = 4000
"""Test presses of `bayes_limit`: the rms is then known to 3 %, its ratio to an estimator's on the same ones better."""


@dataclass(frozen=True)
class BayesProblem:
    """All that the limit depends on, besides the presses.

    Attributes:
        sensor: The sensor.
        probe: The footprint, in the orientation that it has.
        radius: Of the working area, mm; positions are uniform in it.
        force_range: Smallest and largest force, N; log-uniform.
        noise: Of the readings.
    """

    sensor: Sensor
    probe: Probe
    radius: float = DEFAULT_RADIUS
    force_range: tuple[float, float] = DEFAULT_FORCE_RANGE
    noise: NoiseModel = field(default_factory=lambda: noise_model("reference"))

    def forward_map(self, executor: Executor | None = None) -> ForwardMap:
        """The simulator's charges: some 5 s."""
        return ForwardMap.build(self.sensor, self.probe, self.radius, self.force_range, executor=executor)


@dataclass(frozen=True)
class BayesLimit:
    """Errors of the posterior mean.

    Attributes:
        presses: Number of presses.
        position_median_mm, position_rms_mm, position_p95_mm: Of the distance from the true position.
        force_median_percent, force_rms_percent: Of the relative error of the force.
    """

    presses: int
    position_median_mm: float
    position_rms_mm: float
    position_p95_mm: float
    force_median_percent: float
    force_rms_percent: float

    @classmethod
    def of(cls, contact: Array, truth: Array) -> "BayesLimit":
        """From estimates and the true contacts (x, y, F), each (n, 3), mm and N."""
        position = np.hypot(*(contact - truth)[:, :2].T)
        force = 100.0 * (contact[:, 2] / truth[:, 2] - 1.0)
        return cls(
            presses=len(truth),
            position_median_mm=float(np.median(position)),
            position_rms_mm=rms(position),
            position_p95_mm=float(np.percentile(position, 95)),
            force_median_percent=float(np.median(np.abs(force))),
            force_rms_percent=rms(force),
        )


def bayes_estimate(
    problem: BayesProblem,
    charge: Array,
    *,
    charge_map: ForwardMap | ChargeSpline | None = None,
    executor: Executor | None = None,
) -> tuple[Array, Array]:
    """Posterior means for noisy charges: some 15 ms for each.

    Args:
        problem: Sensor, probe, prior and noise.
        charge: Noisy touch charges, shape (n, n_electrode), pC.
        charge_map: The problem's, if it exists; it may reach farther, with exactly the problem's forces.
        executor: Solves and integrates; None for this process. That of a `ResumableRun` keeps what is done.

    Returns:
        Contact (x, y, F), mm and N, and standard deviation of each, both (n, 3). The force is E[1/F] / E[1/F^2],
        which has the least mean square relative error.

    Raises:
        ChargeError: If there are no charges, or they are not finite or of another number of electrodes.
        InputError: If the noise is zero, or the map is of other forces or too small.
    """
    charges = charge_map or problem.forward_map(executor)
    if charges.domain.force_range != problem.force_range:
        raise InputError(
            f"forces of the map: expected the problem's, {problem.force_range} N, got {charges.domain.force_range} N"
        )
    spline = charges if isinstance(charges, ChargeSpline) else ChargeSpline.of(charges)
    return Posterior(spline, problem.noise, problem.radius).mean_and_std(charge, executor)


def bayes_limit(
    problem: BayesProblem,
    presses: int = PRESSES,
    seed: int = 0,
    *,
    charge_map: ForwardMap | ChargeSpline | None = None,
    executor: Executor | None = None,
) -> BayesLimit:
    """The limit of a problem on presses drawn from its prior: a minute.

    Args:
        problem: Sensor, probe, prior and noise.
        presses: Number of presses.
        seed: Of presses and noise.
        charge_map: As for `bayes_estimate`.
        executor: As for `bayes_estimate`.
    """
    charges = charge_map or problem.forward_map(executor)
    contact = Sweep(problem.radius, problem.force_range, presses, seed, sampling="random").contacts()
    charge = problem.noise.add(charges.charges(contact), np.random.default_rng([seed, 1]))
    return BayesLimit.of(bayes_estimate(problem, charge, charge_map=charges, executor=executor)[0], contact)
