"""Studies of the released model: errors over film and force, whether its deviations hold, and what it does where noise,
probe, pretension, gains or an electrode are not as it assumes.
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.simulate import Domain, NoiseModel, parse_probe
from isocharge.simulate.numerics.statistics import rms
from isocharge.train.baselines.compared_methods import ComparedMethod
from isocharge.train.baselines.networks import ReleasedModel
from isocharge.train.data.presses import LabelledPresses, position_error
from isocharge.train.report.case import CRAMER_RAO, EvaluationCase, Settings, press_on
from isocharge.train.report.measures import Errors, coverage, rounded

DRAW_SEED = 90_000
"""Seed of the noise draws, relative to the case's seed."""

NOMINAL = np.array([0.05, *np.arange(0.1, 0.95, 0.1), 0.95, 0.99])
"""Nominal levels of the calibration plot."""

FORCE_BINS = 12
"""Bins of the error against force."""

COORDINATES = ("x", "y", "force")


@dataclass(frozen=True)
class Draws:
    """The released model's answers to the test presses under several draws of the noise.

    Attributes:
        truth: Presses, repeated, shape (n draws, 3).
        contact: Answers, of the same shape.
        std: Their standard deviations.
        misfit: Shape (n draws,).
    """

    truth: Array
    contact: Array
    std: Array
    misfit: Array

    @classmethod
    def of(cls, released: ReleasedModel, clean: LabelledPresses, case: EvaluationCase, draws: int) -> "Draws":
        """So many draws of the case's noise."""
        seeds = range(case.seed + DRAW_SEED, case.seed + DRAW_SEED + draws)
        contact, std, misfit = released.answer(np.concatenate([clean.noisy(case.noise, seed) for seed in seeds]))
        return cls(np.tile(clean.contact, (draws, 1)), contact, std, misfit[:, 0])


def by_force(domain: Domain, truth: Array, contacts: Mapping[str, Array], cramer_rao: Array) -> dict[str, Any]:
    """Root-mean-square position error, mm, of several methods and Cramér-Rao's in bins of equal steps of log force."""
    edges = np.geomspace(*domain.force_range, FORCE_BINS + 1)
    number = np.digitize(truth[:, 2], edges[1:-1])
    errors = {name: position_error(contact, truth[: len(contact)]) for name, contact in contacts.items()}
    lines = {
        name: [_rms_of(error[(number[: len(error)] == k) & np.isfinite(error)]) for k in range(FORCE_BINS)]
        for name, error in {**errors, CRAMER_RAO: cramer_rao}.items()
    }
    return {"force_N": [rounded(value) for value in np.sqrt(edges[:-1] * edges[1:])], "position_rms_mm": lines}


def _rms_of(errors: Array) -> float | None:
    return rounded(rms(errors)) if errors.size else None


def calibration(draws: Draws) -> dict[str, Any]:
    """Coverage of the central intervals at many levels."""
    covered = coverage(draws.contact, draws.std, draws.truth, NOMINAL)
    return {
        "levels": [rounded(level, 3) for level in NOMINAL],
        "coverage": {name: [rounded(share) for share in covered[:, k]] for k, name in enumerate(COORDINATES)},
    }


LEVELS = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Factors on the noise, dimensionless."""

PRETENSION_OFF = 0.2
"""Pretension that the models do not know of, MPa."""

GAIN_OFF, GAIN_WRONG = 0.01, 0.2
"""Standard deviation of unknown gains, and the gain that is plainly wrong."""

ROUGH = 2e-3
"""Accuracy of charges under other probes and pretensions: far below what they change."""

FARTHEST = 50.0
"""Answers farther from zero, mm or N, are cut to this: polynomials explode outside of what they know."""

NOISE_SEED = 515
"""Seed of the noise on every deviation's charges, relative to the case's."""


@dataclass(frozen=True)
class Deviation:
    """Presses that differ from what the models assume.

    Attributes:
        group: "noise", "probe", "pretension", "gain" or "dead electrode".
        name: What is different.
        truth: Contacts, shape (n, 3), mm and N.
        charge: What is measured, shape (n, n_electrode), pC.
    """

    group: str
    name: str
    truth: Array
    charge: Array


def deviations(
    case: EvaluationCase, clean: LabelledPresses, settings: Settings, executor: Executor | None = None
) -> Iterator[Deviation]:
    """Every deviation, from clean test presses of the case."""
    seed, truth, rough = case.seed + NOISE_SEED, clean.contact, max(ROUGH, settings.accuracy)
    for level in LEVELS:
        louder = NoiseModel(f"x {level:g}", level * case.noise.white, level * case.noise.gain)
        yield Deviation("noise", louder.name, truth, clean.noisy(louder, seed))
    others = [("probe", each, replace(case, probes=(parse_probe(each),)), rough) for each in settings.shapes]
    if settings.mismatch_cases:
        film = replace(case.sensor.film, pretension=case.sensor.film.pretension + PRETENSION_OFF)
        taut = replace(case, sensor=replace(case.sensor, film=film))
        others.append(("pretension", f"+{PRETENSION_OFF:g} MPa", taut, ROUGH))
    for group, name, other, accuracy in others:
        presses = press_on(other.forward_maps(accuracy=accuracy, executor=executor), case.sweep())
        yield Deviation(group, name, presses.contact, presses.noisy(case.noise, seed))
    yield from _wrong_gains(case, truth, clean.noisy(case.noise, seed))


def _wrong_gains(case: EvaluationCase, truth: Array, noisy: Array) -> Iterator[Deviation]:
    """Gains off by some 1 %, each sensor differently; one off by 20 %; one dead."""
    rng, names = np.random.default_rng(case.seed + NOISE_SEED), case.sensor.electrode_names
    gains = 1.0 + GAIN_OFF * rng.standard_normal(noisy.shape)
    yield Deviation("gain", f"each off by {100 * GAIN_OFF:g} % rms", truth, gains * noisy)
    silence = case.noise.white * rng.standard_normal(noisy.shape)
    affected = np.eye(len(names), dtype=bool)
    for name, electrode in zip(names, affected, strict=True):
        charge = np.where(electrode, (1.0 + GAIN_WRONG) * noisy, noisy)
        yield Deviation("gain", f"{name} off by {100 * GAIN_WRONG:g} %", truth, charge)
    for name, electrode in zip(names, affected, strict=True):
        yield Deviation("dead electrode", f"{name} dead", truth, np.where(electrode, silence, noisy))


def measured(
    deviation: Deviation,
    name: str,
    released: ReleasedModel,
    compared_methods: Sequence[ComparedMethod],
    threshold: float,
) -> dict[str, Any]:
    """Errors of the released model, by its name, and of others, and how often its misfit gives the alarm."""
    contact, std, misfit = released.answer(deviation.charge)
    with np.errstate(over="ignore"):
        answers = {compared.name: compared.regressor.predict(deviation.charge) for compared in compared_methods}
    clipped = {compared: np.clip(answer, -FARTHEST, FARTHEST) for compared, answer in answers.items()}
    return {
        "group": deviation.group,
        "case": deviation.name,
        "presses": len(deviation.truth),
        "alarms_percent": rounded(100.0 * float(np.mean(misfit[:, 0] > threshold)), 3),
        "coverage_68": rounded(float(np.mean(np.abs(contact - deviation.truth) < std)), 3),
        "errors": {
            compared: asdict(Errors.of(answer, deviation.truth))
            for compared, answer in {name: contact, **clipped}.items()
        },
    }
