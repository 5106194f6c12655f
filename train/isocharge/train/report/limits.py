"""What the noise allows on the test presses: the Bayes limit and Cramér-Rao's."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate import ChargeSpline, ForwardMap
from isocharge.simulate.identifiability.cramer_rao import CramerRao, limits_at
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.bayes.limit import Scene, bayes_estimate
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.report.bench import EvaluationScene
from isocharge.train.report.measures import Errors, rounded

BAYES, CRAMER_RAO = "Bayes limit", "Cramér-Rao"
"""Their names in pictures."""


@dataclass(frozen=True)
class ErrorBounds:
    """Both limits on the same presses.

    Attributes:
        bayes: Posterior means for the first of the noisy test presses, (x_mm, y_mm, force_N), shape (m, 3); None where
            the probe is not known to the sensor, and the posterior would be one over probes, too.
        cramer_rao: Of every press, for unbiased estimates; with several probes as if the first one pressed.
    """

    bayes: Array | None
    cramer_rao: CramerRao

    @property
    def position_mm(self) -> Array:
        """Cramér-Rao's position error, shape (n,)."""
        return 1e3 * self.cramer_rao.position

    def record(self, truth: Array) -> dict[str, Any]:
        """Root-mean-square errors for the record; Cramér-Rao's holds for unbiased estimates only."""
        bayes = None
        if self.bayes is not None:
            bayes = {**Errors.of(self.bayes, truth[: len(self.bayes)]).to_dict(), "presses": len(self.bayes)}
        return {
            "bayes": bayes,
            "cramer_rao": {
                "position_rms_mm": rounded(rms(self.position_mm)),
                "position_median_mm": rounded(float(np.median(self.position_mm))),
                "force_rms_percent": rounded(100.0 * rms(self.cramer_rao.force)),
            },
        }


def error_bounds(
    bench: EvaluationScene,
    forward_maps: tuple[ForwardMap, ...],
    presses: LabelledPresses,
    noisy_pC: Array,
    limited: int,
    progress: Callable[[str], None],
) -> ErrorBounds:
    """Both limits.

    Args:
        bench: Sensor, probe, prior and noise.
        forward_maps: Forward maps over exactly the bench's contacts, one for each probe.
        presses: Clean test presses.
        noisy_pC: Their charges with noise, shape (n, n_electrode).
        limited: For how many of them the posterior is integrated.
        progress: Called with a text.
    """
    bayes, charges = None, ChargeSpline.of(forward_maps[0])
    if len(forward_maps) == 1 and not bench.turned:
        scene = Scene(bench.sensor, bench.probes[0], bench.domain.radius_mm, bench.domain.force_range_N, bench.noise)
        bayes = bayes_estimate(
            scene,
            noisy_pC[:limited],
            forward_map=charges,
            progress=lambda done, total: progress(f"integrating the Bayes limit: {done} of {total} presses"),
        )[0]
    return ErrorBounds(bayes, limits_at(charges, presses.contact * np.array([1e-3, 1e-3, 1.0]), bench.noise))
