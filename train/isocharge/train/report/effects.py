"""Errors where the film differs from what the model assumes: noise, probe, pretension, gains, a dead electrode."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import IsochargeError
from isocharge.common.progress import Announce
from isocharge.simulate import Sensor, SolveSettings, parse_probe
from isocharge.simulate.measuring_chain.noise import NoiseModel
from isocharge.train.baselines import Fitted, FittingTask, GaussNewton, PolynomialRidge, ReleasedModel
from isocharge.train.data.alarms import about_1_N, alarm_threshold
from isocharge.train.data.noise import noisy_charges
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.report.bench import EvaluationScene, press_on
from isocharge.train.report.measures import Errors, rounded
from isocharge.train.report.settings import Settings

LEVELS = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Factors on the noise, dimensionless."""

PRETENSION_OFF = 0.2e6
"""Pretension that the models do not know of, Pa."""

GAIN_OFF, GAIN_WRONG = 0.01, 0.2
"""Standard deviation of unknown gains, and the gain that is plainly wrong."""

OUTSIDE = 1.25
"""Distance of presses outside the working area, at most, relative to its radius, dimensionless."""

ROUGH = 2e-3
"""Accuracy of charges under other probes and pretensions: far below what they change."""

FARTHEST = 50.0
"""Answers farther from zero, mm or N, are cut to this: polynomials explode outside of what they know."""

NOISE_SEED = 515
"""Seed of the noise on every case's charges, relative to the scene's."""


@dataclass(frozen=True)
class Case:
    """Presses that differ from what the models assume.

    Attributes:
        group: "noise", "probe", "pretension", "gain", "dead electrode" or "elsewhere".
        name: What is different.
        presses: Clean presses.
        charge_pC: What is measured, shape (n, n_electrode).
        known: Whether a model could answer: false for presses that it has no answer for.
    """

    group: str
    name: str
    presses: LabelledPresses
    charge_pC: Array
    known: bool = True


def cases(bench: EvaluationScene, clean: LabelledPresses, settings: Settings, progress: Announce) -> Iterator[Case]:
    """Every case, from clean test presses of the bench."""
    sweep = bench.sweep()

    def noisy(presses: LabelledPresses) -> Array:
        return noisy_charges(presses, bench.noise, bench.seed + NOISE_SEED)

    for level in LEVELS:
        yield Case("noise", f"x {level:g}", clean, _with_louder_noise(clean, bench, level))
    for notation in settings.shapes:
        progress(f"solving the film under {notation}")
        rough = SolveSettings(accuracy=max(ROUGH, settings.accuracy))
        presses = press_on(bench.forward_maps(probes=(parse_probe(notation),), settings=rough), sweep)
        yield Case("probe", notation, presses, noisy(presses))
    if settings.mismatch_cases:
        progress("solving a film with more pretension")
        forward_maps = bench.forward_maps(
            sensor=_with_more_pretension(bench.sensor), settings=SolveSettings(accuracy=ROUGH)
        )
        presses = press_on(forward_maps, sweep)
        yield Case("pretension", f"+{1e-6 * PRETENSION_OFF:g} MPa", presses, noisy(presses))
    yield from _wrong_gains(bench, clean, noisy(clean))
    if settings.mismatch_cases:
        progress("solving the film outside of the working area")
        yield from _outside(bench, noisy)


def _with_more_pretension(sensor: Sensor) -> Sensor:
    return replace(sensor, film=replace(sensor.film, pretension=sensor.film.pretension + PRETENSION_OFF))


def _with_louder_noise(clean: LabelledPresses, bench: EvaluationScene, level: float) -> Array:
    louder = NoiseModel(f"x {level:g}", level * bench.noise.white, level * bench.noise.gain)
    return noisy_charges(clean, louder, bench.seed + NOISE_SEED)


def _wrong_gains(bench: EvaluationScene, clean: LabelledPresses, noisy: Array) -> Iterator[Case]:
    """Gains off by some 1 %, each sensor differently; one off by 20 %; one dead."""
    rng = np.random.default_rng(bench.seed + NOISE_SEED)
    gains = 1.0 + GAIN_OFF * rng.standard_normal(noisy.shape)
    yield Case("gain", f"each off by {100 * GAIN_OFF:g} % rms", clean, gains * noisy)
    for number, name in enumerate(bench.sensor.electrode_names):
        affected = np.arange(noisy.shape[1]) == number
        yield Case(
            "gain",
            f"{name} off by {100 * GAIN_WRONG:g} %",
            clean,
            np.where(affected, (1.0 + GAIN_WRONG) * noisy, noisy),
        )
    silence = 1e12 * bench.noise.white * rng.standard_normal(noisy.shape)
    for number, name in enumerate(bench.sensor.electrode_names):
        affected = np.arange(noisy.shape[1]) == number
        yield Case("dead electrode", f"{name} dead", clean, np.where(affected, silence, noisy))


def _outside(bench: EvaluationScene, noisy: Callable[[LabelledPresses], Array]) -> Iterator[Case]:
    """Presses beyond the working area, where the film is large enough."""
    try:
        forward_maps = bench.forward_maps(further=OUTSIDE, settings=SolveSettings(accuracy=ROUGH))
    except IsochargeError:
        return
    low, high = bench.domain.force_range_N
    presses = press_on(forward_maps, replace(bench.sweep(OUTSIDE), force_range=(low, high)))
    beyond = np.hypot(*presses.contact[:, :2].T) > bench.domain.radius_mm
    presses = presses[np.flatnonzero(beyond)]
    reach = f"up to {(OUTSIDE - 1.0) * bench.domain.radius_mm:.2g} mm outside the working area"
    yield Case("elsewhere", reach, presses, noisy(presses), known=False)


def measure(
    every: Iterator[Case], released: ReleasedModel, rivals: list[Fitted], threshold: float
) -> list[dict[str, Any]]:
    """Errors of several methods in every case, and how often the released model's misfit gives the alarm."""
    return [_measured(case, released, rivals, threshold) for case in every]


def _measured(case: Case, released: ReleasedModel, rivals: list[Fitted], threshold: float) -> dict[str, Any]:
    truth = case.presses.contact
    contact, std, misfit = released.answer(case.charge_pC)
    alarm = misfit[:, 0] > threshold
    about = about_1_N(truth[:, 2])
    with np.errstate(over="ignore"):
        answers = {rival.name: np.clip(rival.predict(case.charge_pC), -FARTHEST, FARTHEST) for rival in rivals}
    contacts = {released.name: contact, **answers} if case.known else {}
    return {
        "group": case.group,
        "case": case.name,
        "presses": len(truth),
        "alarms_percent": rounded(100.0 * float(np.mean(alarm)), 3),
        "alarms_percent_about_1N": rounded(100.0 * float(np.mean(alarm[about])), 3) if about.any() else None,
        "coverage_68": rounded(float(np.mean(np.abs(contact - truth) < std)), 3) if case.known else None,
        "errors": {name: Errors.of(answer, truth).to_dict() for name, answer in contacts.items()} or None,
    }


def threshold_of(released: ReleasedModel, clean: LabelledPresses, bench: EvaluationScene, draws: int) -> float:
    """The misfit that 1 % of good test presses exceed."""
    seeds = range(bench.seed + NOISE_SEED + 1, bench.seed + NOISE_SEED + 1 + draws)
    misfits = [released.answer(noisy_charges(clean, bench.noise, seed))[2] for seed in seeds]
    return alarm_threshold(np.concatenate(misfits))


def without_one_electrode(
    task: FittingTask, bench: EvaluationScene, clean: LabelledPresses, progress: Announce
) -> list[dict[str, Any]]:
    """A known dead electrode: methods fitted again to the charges that remain. Empty where fewer than three remain."""
    names = bench.sensor.electrode_names
    if len(names) < 4:
        return []
    noisy, records = noisy_charges(clean, bench.noise, bench.seed + NOISE_SEED), []
    for number, name in enumerate(names):
        progress(f"fitting without electrode {name}")
        alive = np.arange(len(names)) != number
        fewer = replace(task, train=_only(task.train, alive), validation=_only(task.validation, alive))
        forms = [
            estimator.fit(fewer)[-1] for estimator in (PolynomialRidge(degrees=(8, 10), alphas=(1e-11,)), GaussNewton())
        ]
        errors = {form.name: Errors.of(form.predict(noisy[:, alive]), clean.contact).to_dict() for form in forms}
        records.append({"without": name, "errors": errors})
    return records


def _only(presses: LabelledPresses, electrodes: np.ndarray) -> LabelledPresses:
    return LabelledPresses(presses.contact, presses.charge_pC[:, electrodes])
