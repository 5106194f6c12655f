"""The Bayes limit: the errors of the posterior mean, which no estimator of x, y, F can beat on average.

    scene = Scene(load_sensor("three-25um-biaxial"), Circle(1e-3), radius_mm=8.0, force_range_N=(0.05, 2.0))
    print(bayes_limit(scene).position_rms_mm)

Both functions store their results in the cache folder (`isocharge.train.bayes.cache`).
"""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE, DEFAULT_RADIUS
from isocharge.common.errors import ChargeError, InputError
from isocharge.common.files import sha256_of
from isocharge.common.progress import Progress
from isocharge.simulate.dataset.sampling import Sweep
from isocharge.simulate.execution.code_version import code_fingerprint
from isocharge.simulate.forward.charge_spline import ChargeSpline
from isocharge.simulate.forward.forward_map import ForwardMap
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.simulate.measuring_chain.noise_file import noise_model
from isocharge.simulate.numerics.statistics import rms
from isocharge.simulate.sensor.probe import Probe
from isocharge.simulate.sensor.sensor import Sensor
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.bayes.cache import cached
from isocharge.train.bayes.posterior import CHUNK, STEP, Posterior

PRESSES = 4000
"""Test presses of `bayes_limit`: the rms is then known to 3 %, its ratio to an estimator's on the same ones better."""

METHOD = 1
"""Version of the integration; results of an older version are computed again."""


@dataclass(frozen=True)
class Scene:
    """All that the limit depends on, besides the presses.

    Attributes:
        sensor: The sensor.
        probe: The footprint, in the orientation that it has.
        radius_mm: Of the working area; positions are uniform in it.
        force_range_N: Smallest and largest force; log-uniform.
        noise: Of the readings.
    """

    sensor: Sensor
    probe: Probe
    radius_mm: float = 1e3 * DEFAULT_RADIUS
    force_range_N: tuple[float, float] = DEFAULT_FORCE_RANGE
    noise: NoiseModel = field(default_factory=lambda: noise_model("reference"))

    def forward_map(self) -> ForwardMap:
        """The simulator's charges over the scene: some 5 s."""
        return ForwardMap.build(self.sensor, self.probe, 1e-3 * self.radius_mm, self.force_range_N)

    def key(self) -> dict[str, Any]:
        """For the cache."""
        return {
            "sensor": sensor_to_dict(self.sensor),
            "probe": f"{self.probe.notation}@{np.rad2deg(self.probe.angle):.12g}",
            "radius_mm": self.radius_mm,
            "force_range_N": list(self.force_range_N),
            "noise": [self.noise.white, self.noise.gain],
            "made_by": code_fingerprint(),
            "method": METHOD,
            "step": STEP,
        }


@dataclass(frozen=True)
class BayesLimit:
    """Errors of the posterior mean.

    Attributes:
        presses: Number of presses.
        position_median_mm, position_rms_mm, position_p95_mm: Of the distance from the true position.
        force_median_percent, force_rms_percent: Of the relative error of the force.
        expected_position_rms_mm, expected_force_rms_percent: What the posterior's own standard deviations say; they
            vary less from one set of presses to another.
    """

    presses: int
    position_median_mm: float
    position_rms_mm: float
    position_p95_mm: float
    force_median_percent: float
    force_rms_percent: float
    expected_position_rms_mm: float
    expected_force_rms_percent: float

    @classmethod
    def of(cls, contact: Array, std: Array, truth: Array) -> "BayesLimit":
        """From estimates, their standard deviations and the true contacts (x_mm, y_mm, force_N), each (n, 3)."""
        position = np.hypot(*(contact - truth)[:, :2].T)
        force = 100.0 * (contact[:, 2] / truth[:, 2] - 1.0)
        return cls(
            presses=len(truth),
            position_median_mm=float(np.median(position)),
            position_rms_mm=rms(position),
            position_p95_mm=float(np.percentile(position, 95)),
            force_median_percent=float(np.median(np.abs(force))),
            force_rms_percent=rms(force),
            expected_position_rms_mm=rms(np.hypot(*std[:, :2].T)),
            expected_force_rms_percent=100.0 * rms(std[:, 2] / contact[:, 2]),
        )

    def to_dict(self) -> dict[str, float | int]:
        """For JSON."""
        return asdict(self)


def bayes_estimate(
    scene: Scene,
    charge_pC: Array,
    *,
    forward_map: ForwardMap | ChargeSpline | None = None,
    progress: Progress | None = None,
) -> tuple[Array, Array]:
    """Posterior means for noisy charges: some 15 ms for each, from the cache if the same charges were asked before.

    Args:
        scene: Sensor, probe, prior and noise.
        charge_pC: Noisy touch charges, shape (n, n_electrode), pC.
        forward_map: The scene's, if it exists; it may reach farther than the scene, with exactly the scene's forces.
        progress: Called with the presses done and all presses.

    Returns:
        Contact (x_mm, y_mm, force_N) and standard deviation of each, both (n, 3). The force is E[1/F] / E[1/F^2],
        which has the least mean square relative error.

    Raises:
        ChargeError: If the charges are not finite or of another number of electrodes.
        InputError: If the noise is zero, or the map is of other forces or too small.
    """
    charge = np.ascontiguousarray(charge_pC, dtype=float)
    key = {**scene.key(), "charges": f"{charge.shape} {sha256_of(charge.tobytes())}"}

    def compute() -> list[Any]:
        posterior = Posterior(_spline(scene, forward_map), scene.noise, 1e-3 * scene.radius_mm)
        mean, std = _in_chunks(posterior, 1e-12 * charge, progress)
        return [np.round(part, 9).tolist() for part in (_in_millimetres(mean), _in_millimetres(std))]

    contact, std = (np.array(part) for part in cached("bayes", key, compute))
    return contact, std


def bayes_limit(
    scene: Scene,
    presses: int = PRESSES,
    seed: int = 0,
    *,
    forward_map: ForwardMap | None = None,
    progress: Progress | None = None,
) -> BayesLimit:
    """The limit of a scene on presses drawn from its prior: a minute, then from the cache.

    Args:
        scene: Sensor, probe, prior and noise.
        presses: Number of presses.
        seed: Of presses and noise.
        forward_map: The scene's, if it exists.
        progress: Called with the presses done and all presses.
    """

    def compute() -> dict[str, Any]:
        charges = forward_map or scene.forward_map()
        sweep = Sweep(1e-3 * scene.radius_mm, scene.force_range_N, presses, seed, sampling="random")
        x, y, force, _ = sweep.presses()
        charge = scene.noise.add(charges.forward(x, y, force), np.random.default_rng([seed, 1]))
        contact, std = bayes_estimate(scene, 1e12 * charge, forward_map=charges, progress=progress)
        return BayesLimit.of(contact, std, np.stack([1e3 * x, 1e3 * y, force], axis=1)).to_dict()

    return BayesLimit(**cached("bayes-limit", {**scene.key(), "presses": presses, "seed": seed}, compute))


def _spline(scene: Scene, forward_map: ForwardMap | ChargeSpline | None) -> ChargeSpline:
    charges = forward_map or scene.forward_map()
    if charges.force_range != scene.force_range_N:
        raise InputError(
            f"forces of the map: expected the scene's, {scene.force_range_N} N, got {charges.force_range} N"
        )
    return charges if isinstance(charges, ChargeSpline) else ChargeSpline.of(charges)


def _in_chunks(posterior: Posterior, charge: Array, progress: Progress | None) -> tuple[Array, Array]:
    parts = []
    for start in range(0, len(charge), CHUNK):
        parts.append(posterior.mean_and_std(charge[start : start + CHUNK]))
        if progress:
            progress(min(start + CHUNK, len(charge)), len(charge))
    if not parts:
        raise ChargeError("expected charges of at least one press, got none")
    mean, std = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return mean, std


def _in_millimetres(values: Array) -> Array:
    in_mm: Array = values * np.array([1e3, 1e3, 1.0])
    return in_mm
