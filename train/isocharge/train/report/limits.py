"""What the noise allows on the test presses: the Bayes limit and Cramér-Rao's."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.simulate import ForwardMap
from isocharge.simulate.arrays import Array
from isocharge.train.bayes import Scene, bayes_estimate
from isocharge.train.report.bench import Bench
from isocharge.train.report.measures import errors, rms, rounded
from isocharge.train.split import Presses


@dataclass(frozen=True)
class Limits:
    """Both limits on the same presses.

    Attributes:
        bayes: Posterior means for the first of the noisy test presses, (x_mm, y_mm, force_N), shape (m, 3); None where
            the probe is not known to the sensor, and the posterior would be one over probes, too.
        cramer_rao: Smallest standard deviations of an unbiased estimate, (x_mm, y_mm, force_N), shape (n, 3).
    """

    bayes: Array | None
    cramer_rao: Array

    @property
    def position_mm(self) -> Array:
        """Cramér-Rao's position error, root of the sum of both variances, shape (n,)."""
        return np.hypot(self.cramer_rao[:, 0], self.cramer_rao[:, 1])

    def record(self, truth: Array) -> dict[str, Any]:
        """Root-mean-square errors for the record; Cramér-Rao's holds for unbiased estimates only."""
        bayes = None
        if self.bayes is not None:
            bayes = {**errors(self.bayes, truth[: len(self.bayes)]), "presses": len(self.bayes)}
        return {
            "bayes": bayes,
            "cramer_rao": {
                "position_rms_mm": rounded(rms(self.position_mm)),
                "position_median_mm": rounded(float(np.median(self.position_mm))),
                "force_rms_percent": rounded(100.0 * rms(self.cramer_rao[:, 2] / truth[:, 2])),
            },
        }


def limits_of(
    bench: Bench,
    films: tuple[ForwardMap, ...],
    presses: Presses,
    noisy_pC: Array,
    limited: int,
    progress: Callable[[str], None],
) -> Limits:
    """Both limits.

    Args:
        bench: Sensor, probe, prior and noise.
        films: Forward maps over exactly the bench's contacts, one for each probe.
        presses: Clean test presses.
        noisy_pC: Their charges with noise, shape (n, n_electrode).
        limited: For how many of them the posterior is integrated.
        progress: Told how it goes.
    """
    bayes = None
    if len(films) == 1 and not bench.turned:
        scene = Scene(bench.sensor, bench.probes[0], bench.domain.radius_mm, bench.domain.force_range_N, bench.noise)
        bayes = bayes_estimate(
            scene,
            noisy_pC[:limited],
            forward_map=films[0],
            progress=lambda done, total: progress(f"integrating the Bayes limit: {done} of {total} presses"),
        )[0]
    return Limits(bayes, _cramer_rao(bench, films, presses))


STEP = 1e-5
"""Step of the difference quotients, in radii and relative force."""


def _cramer_rao(bench: Bench, films: tuple[ForwardMap, ...], presses: Presses) -> Array:
    """TEMPORARY until isocharge.simulate.limits is there."""
    film, radius = films[0], 1e-3 * bench.domain.radius_mm
    x, y, force = presses.contact.T * np.array([[1e-3], [1e-3], [1.0]])
    inward = np.minimum(1.0, (radius - 2 * STEP * radius) / np.maximum(np.hypot(x, y), 1e-9))
    x, y, force = (
        x * inward,
        y * inward,
        np.clip(force, bench.domain.force_range_N[0] * 1.001, bench.domain.force_range_N[1] * 0.999),
    )
    h = STEP * radius
    slopes = (
        np.stack(
            [
                (film.forward(x + h, y, force) - film.forward(x - h, y, force)) / (2 * h),
                (film.forward(x, y + h, force) - film.forward(x, y - h, force)) / (2 * h),
                (film.forward(x, y, force * (1 + STEP)) - film.forward(x, y, force * (1 - STEP)))
                / (2 * STEP * force)[:, None],
            ],
            axis=1,
        )
        / bench.noise.sigma(1e-12 * presses.charge_pC)[:, None]
    )
    covariance = np.linalg.inv(slopes @ slopes.transpose(0, 2, 1))
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)) * np.array([1e3, 1e3, 1.0])
