"""What the noise allows on the test presses: the Bayes limit and Cramér-Rao's."""

from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate import ChargeSpline, limits_at
from isocharge.simulate.identifiability.cramer_rao import CramerRao
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.bayes.limit import BayesProblem, bayes_estimate
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.report.case import EvaluationCase
from isocharge.train.report.measures import Errors, rounded

BAYES, CRAMER_RAO = "Bayes limit", "Cramér-Rao"
"""Their names in pictures."""


@dataclass(frozen=True)
class ErrorBounds:
    """Both limits on the same presses.

    Attributes:
        bayes: Posterior means for the first of the noisy test presses, (x, y, F), shape (m, 3), mm and N; None where
            the probe is not known to the sensor, and the posterior would be one over probes, too.
        cramer_rao: Of every press, for unbiased estimates; with several probes as if the first one pressed.
    """

    bayes: Array | None
    cramer_rao: CramerRao

    @classmethod
    def of(
        cls,
        case: EvaluationCase,
        charges: ChargeSpline,
        clean: LabelledPresses,
        noisy: Array,
        executor: Executor | None = None,
    ) -> "ErrorBounds":
        """Both limits.

        Args:
            case: Sensor, probe, prior and noise.
            charges: Of the case's first probe, over exactly its contacts.
            clean: Test presses.
            noisy: Charges of the first of them with noise, shape (m, n_electrode), pC: for the Bayes limit.
            executor: Integrates.
        """
        bayes = None
        if len(case.probes) == 1 and not case.rotated:
            problem = BayesProblem(case.sensor, case.probes[0], case.domain.radius, case.domain.force_range, case.noise)
            bayes, _ = bayes_estimate(problem, noisy, charge_map=charges, executor=executor)
        return cls(bayes, limits_at(charges, clean.contact, case.noise))

    def record(self, truth: Array) -> dict[str, Any]:
        """Root-mean-square errors for the record; Cramér-Rao's holds for unbiased estimates only."""
        bayes, position = None, self.cramer_rao.position
        if self.bayes is not None:
            bayes = {**Errors.of(self.bayes, truth[: len(self.bayes)]).to_dict(), "presses": len(self.bayes)}
        return {
            "bayes": bayes,
            "cramer_rao": {
                "position_rms_mm": rounded(rms(position)),
                "position_median_mm": rounded(float(np.median(position))),
                "force_rms_percent": rounded(100.0 * rms(self.cramer_rao.force)),
            },
        }
