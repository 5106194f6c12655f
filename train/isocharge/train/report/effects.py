"""Errors where the film differs from what the model assumes: noise, probe, pretension, gains, a dead electrode."""

from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.common.errors import IsochargeError
from isocharge.simulate import NoiseModel, parse_probe
from isocharge.train.baselines.networks import ReleasedModel
from isocharge.train.baselines.rival import Rival
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.model_release.evaluate import about_1_N, alarm_threshold
from isocharge.train.report.case import EvaluationCase, press_on
from isocharge.train.report.measures import Errors, rounded
from isocharge.train.report.settings import Settings

LEVELS = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Factors on the noise, dimensionless."""

PRETENSION_OFF = 0.2
"""Pretension that the models do not know of, MPa."""

GAIN_OFF, GAIN_WRONG = 0.01, 0.2
"""Standard deviation of unknown gains, and the gain that is plainly wrong."""

OUTSIDE = 1.25
"""Distance of presses outside the working area, at most, relative to its radius, dimensionless."""

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
        group: "noise", "probe", "pretension", "gain", "dead electrode" or "elsewhere".
        name: What is different.
        truth: Contacts, shape (n, 3), mm and N.
        charge: What is measured, shape (n, n_electrode), pC.
        known: Whether a model could answer: false for presses that it has no answer for.
    """

    group: str
    name: str
    truth: Array
    charge: Array
    known: bool = True


def deviations(
    case: EvaluationCase, clean: LabelledPresses, settings: Settings, executor: Executor | None = None
) -> Iterator[Deviation]:
    """Every deviation, from clean test presses of the case."""
    seed, truth, rough = case.seed + NOISE_SEED, clean.contact, max(ROUGH, settings.accuracy)
    for level in LEVELS:
        louder = NoiseModel(f"x {level:g}", level * case.noise.white, level * case.noise.gain)
        yield Deviation("noise", louder.name, truth, clean.noisy(louder, seed))
    for notation in settings.shapes:
        maps = case.forward_maps(probes=(parse_probe(notation),), accuracy=rough, executor=executor)
        presses = press_on(maps, case.sweep())
        yield Deviation("probe", notation, presses.contact, presses.noisy(case.noise, seed))
    if settings.mismatch_cases:
        film = replace(case.sensor.film, pretension=case.sensor.film.pretension + PRETENSION_OFF)
        maps = case.forward_maps(sensor=replace(case.sensor, film=film), accuracy=ROUGH, executor=executor)
        presses = press_on(maps, case.sweep())
        name = f"+{PRETENSION_OFF:g} MPa"
        yield Deviation("pretension", name, presses.contact, presses.noisy(case.noise, seed))
    yield from _wrong_gains(case, truth, clean.noisy(case.noise, seed))
    if settings.mismatch_cases:
        yield from _outside(case, executor)


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


def _outside(case: EvaluationCase, executor: Executor | None) -> Iterator[Deviation]:
    """Presses beyond the working area, where the film is large enough."""
    try:
        maps = case.forward_maps(further=OUTSIDE, accuracy=ROUGH, executor=executor)
    except IsochargeError:
        return
    presses = press_on(maps, replace(case.sweep(OUTSIDE), force_range=case.domain.force_range))
    presses = presses[np.hypot(*presses.contact[:, :2].T) > case.domain.radius]
    reach = f"up to {(OUTSIDE - 1.0) * case.domain.radius:.2g} mm outside the working area"
    noisy = presses.noisy(case.noise, case.seed + NOISE_SEED)
    yield Deviation("elsewhere", reach, presses.contact, noisy, known=False)


def measured(
    deviation: Deviation, name: str, released: ReleasedModel, rivals: Sequence[Rival], threshold: float
) -> dict[str, Any]:
    """Errors of the released model, by its name, and of others, and how often its misfit gives the alarm."""
    truth, about = deviation.truth, about_1_N(deviation.truth[:, 2])
    contact, std, misfit = released.answer(deviation.charge)
    alarm, errors = misfit[:, 0] > threshold, None
    if deviation.known:
        with np.errstate(over="ignore"):
            answers = {rival.name: rival.regressor.predict(deviation.charge) for rival in rivals}
        clipped = {rival: np.clip(answer, -FARTHEST, FARTHEST) for rival, answer in answers.items()}
        errors = {rival: Errors.of(answer, truth).to_dict() for rival, answer in {name: contact, **clipped}.items()}
    return {
        "group": deviation.group,
        "case": deviation.name,
        "presses": len(truth),
        "alarms_percent": _percent(alarm),
        "alarms_percent_about_1N": _percent(alarm[about]) if about.any() else None,
        "coverage_68": rounded(float(np.mean(np.abs(contact - truth) < std)), 3) if deviation.known else None,
        "errors": errors,
    }


def _percent(alarm: Booleans) -> float | None:
    return rounded(100.0 * float(np.mean(alarm)), 3)


def threshold_of(released: ReleasedModel, clean: LabelledPresses, case: EvaluationCase, draws: int) -> float:
    """The misfit that 1 % of good test presses exceed."""
    seeds = range(case.seed + NOISE_SEED + 1, case.seed + NOISE_SEED + 1 + draws)
    return alarm_threshold(np.concatenate([released.answer(clean.noisy(case.noise, seed))[2] for seed in seeds]))
