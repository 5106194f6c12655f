"""Studies of the errors of the evaluated model in addition to its mean error.

One study computes the errors as a function of the place and of the force. Another study computes the coverage of the
reported standard deviations. A third study computes the errors under conditions that differ from the training: other
noise, another probe, another pretension, wrong gains or a dead electrode.
"""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from isocharge.common.arrays import Array, Integers
from isocharge.common.contact_errors import position_error
from isocharge.common.statistics import rms
from isocharge.simulate import Domain, NoiseModel, parse_probe
from isocharge.train.baselines.compared_methods import ComparedMethod
from isocharge.train.baselines.networks import StoredModel
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.report.case import CRAMER_RAO, EvaluationCase, Settings, simulate_presses
from isocharge.train.report.measures import ContactErrors, interval_coverage, round_significant

NOISE_DRAWS_SEED = 90_000
"""Seed of the first noise draw of `NoiseDraws`, relative to the seed of the case."""

NOMINAL_LEVELS = np.array([0.05, *np.arange(0.1, 0.95, 0.1), 0.95, 0.99])
"""Nominal probabilities of the central intervals whose coverage is measured."""

FORCE_BINS = 12
"""Number of force bins in which the position error is computed."""

COORDINATES = ("x", "y", "force")
"""Names of the three quantities of a contact, in the order of its columns."""


@dataclass(frozen=True)
class NoiseDraws:
    """Estimates of the evaluated model for all test presses under several draws of the noise.

    Attributes:
        truth: True contacts (x, y, F), repeated for each draw, shape (n_press * n_draw, 3), mm and N.
        estimate: Estimated contacts, shape (n_press * n_draw, 3), mm and N.
        std: Standard deviations reported by the model, shape (n_press * n_draw, 3), mm and N.
        misfit: Misfits reported by the model, shape (n_press * n_draw,), in standard deviations of the noise.
    """

    truth: Array
    estimate: Array
    std: Array
    misfit: Array

    @classmethod
    def draw(
        cls, evaluated_model: StoredModel, clean_presses: LabelledPresses, case: EvaluationCase, draw_count: int
    ) -> "NoiseDraws":
        """Draw the noise of the test presses several times, and estimate all contacts each time.

        Args:
            evaluated_model: The evaluated model.
            clean_presses: The test presses without noise.
            case: The case, with noise and seed.
            draw_count: Number of noise draws for each press.

        Returns:
            The estimates of all draws, one after the other.
        """
        first_seed = case.seed + NOISE_DRAWS_SEED
        charges_by_draw = [clean_presses.noisy(case.noise, first_seed + draw) for draw in range(draw_count)]
        all_charges = np.concatenate(charges_by_draw)  # shape (draw_count * n_press, n_electrode)
        estimate, std, misfit = evaluated_model.answer(all_charges)
        truth = np.tile(clean_presses.contact, (draw_count, 1))
        return cls(truth, estimate, std, misfit[:, 0])


def errors_by_force(
    domain: Domain, truth: Array, estimates: Mapping[str, Array], cramer_rao_mm: Array
) -> dict[str, Any]:
    """Compute the root-mean-square position error of several methods in logarithmic bins of the force.

    Args:
        domain: The range of forces.
        truth: True contacts (x, y, F), shape (n, 3), mm and N.
        estimates: Estimated contacts of the first m presses by the name of the method, shape (m, 3), mm and N. Presses
            without an estimate are NaN.
        cramer_rao_mm: Cramér-Rao limit of the position, shape (n,), mm.

    Returns:
        The geometric centres of the bins ("force_N"), and the errors in the bins by the name of the method
        ("position_rms_mm"). The Cramér-Rao limit is one of these methods. An error is None if a bin contains no
        estimate.
    """
    min_force, max_force = domain.force_range
    edges = np.geomspace(min_force, max_force, FORCE_BINS + 1)
    geometric_centres = np.sqrt(edges[:-1] * edges[1:])
    true_force = truth[:, 2]
    bin_index = np.digitize(true_force, edges[1:-1])  # with the inner edges, the first bin has the index 0

    errors_by_name = {}
    for name, estimate in estimates.items():
        errors_by_name[name] = position_error(estimate, truth[: len(estimate)])
    errors_by_name[CRAMER_RAO] = cramer_rao_mm

    binned_errors = {}
    for name, errors in errors_by_name.items():
        binned_errors[name] = _rms_in_bins(errors, bin_index[: len(errors)])
    return {
        "force_N": [round_significant(force) for force in geometric_centres],
        "position_rms_mm": binned_errors,
    }


def _rms_in_bins(errors: Array, bin_index: Integers) -> list[float | None]:
    """Return the root mean square of the finite errors of the presses in each force bin.

    Args:
        errors: Errors of the presses, shape (n,), mm.
        bin_index: Index of the force bin of each press, shape (n,).

    Returns:
        Errors, mm; None for a bin without finite errors.
    """
    is_finite = np.isfinite(errors)
    rms_by_bin: list[float | None] = []
    for index in range(FORCE_BINS):
        errors_in_bin = errors[is_finite & (bin_index == index)]
        bin_rms = round_significant(rms(errors_in_bin)) if errors_in_bin.size else None
        rms_by_bin.append(bin_rms)
    return rms_by_bin


def coverage_by_level(draws: NoiseDraws) -> dict[str, Any]:
    """Compute the coverage of the central intervals at many nominal levels.

    Args:
        draws: Estimates of the evaluated model under several draws of the noise, with their standard deviations.

    Returns:
        The nominal levels ("levels"), and for x, y and the force the fractions of true values inside the intervals
        ("coverage").
    """
    coverage = interval_coverage(draws.estimate, draws.std, draws.truth, NOMINAL_LEVELS)
    return {
        "levels": [round_significant(level, 3) for level in NOMINAL_LEVELS],
        "coverage": {
            name: [round_significant(fraction) for fraction in fractions]
            for name, fractions in zip(COORDINATES, coverage.T, strict=True)
        },
    }


NOISE_FACTORS = (0.1, 0.3, 1.0, 3.0, 10.0)
"""Factors by which the noise is multiplied to test the methods with less and more noise, dimensionless."""

PRETENSION_ERROR_MPa = 0.2
"""Difference between the pretension of the tested film and the pretension that the models assume, MPa."""

GAIN_STD = 0.01
"""Relative standard deviation of the gains in the mismatch in which all gains are wrong."""

SINGLE_GAIN_ERROR = 0.2
"""Relative error of the gain in the mismatches in which only one gain is wrong."""

MISMATCH_ACCURACY = 2e-3
"""Relative accuracy of the simulated charges for other probes and pretensions.

This error is small compared with the change of the charges by another probe or pretension.
"""

CLIP_LIMIT = 50.0
"""Largest magnitude of an estimate, mm or N. Larger estimates are clipped, because polynomials can diverge."""

MISMATCH_NOISE_SEED = 515
"""Seed of the noise on the charges of a mismatch, relative to the seed of the case."""


@dataclass(frozen=True)
class Mismatch:
    """Presses under conditions that differ from the assumptions of the models.

    Attributes:
        group: Kind of the difference: "noise", "probe", "pretension", "gain" or "dead electrode".
        name: Description of the difference.
        truth: True contacts (x, y, F), shape (n, 3), mm and N.
        charge: Measured charges with noise, shape (n, n_electrode), pC.
    """

    group: str
    name: str
    truth: Array
    charge: Array


def mismatches(
    case: EvaluationCase, clean_presses: LabelledPresses, settings: Settings, executor: Executor | None = None
) -> Iterator[Mismatch]:
    """Yield the presses of all mismatches: other noise, other probes, another pretension, wrong gains, dead electrodes.

    A mismatch is a condition that differs from the assumptions of the models. Only the other probes and the other
    pretension require new solutions of the film. The test with another pretension can be excluded by the settings.

    Args:
        case: The conditions that the models assume.
        clean_presses: The test presses of the case without noise.
        settings: Settings of the report: the other probes, the accuracy, and whether the pretension is changed.
        executor: Executor of the simulations of the film; None to simulate in this process.
    """
    noise_seed = case.seed + MISMATCH_NOISE_SEED
    for factor in NOISE_FACTORS:
        noise = NoiseModel(f"x {factor:g}", factor * case.noise.white, factor * case.noise.gain)
        yield Mismatch("noise", noise.name, clean_presses.contact, clean_presses.noisy(noise, noise_seed))

    probe_accuracy = max(MISMATCH_ACCURACY, settings.accuracy)  # a quick report solves the film less accurately
    for notation in settings.shapes:
        case_of_other_probe = replace(case, probes=(parse_probe(notation),))
        yield _solved_mismatch("probe", notation, case_of_other_probe, probe_accuracy, executor)

    if settings.mismatch_cases:
        film = replace(case.sensor.film, pretension=case.sensor.film.pretension + PRETENSION_ERROR_MPa)
        case_of_other_film = replace(case, sensor=replace(case.sensor, film=film))
        name = f"+{PRETENSION_ERROR_MPa:g} MPa"
        yield _solved_mismatch("pretension", name, case_of_other_film, MISMATCH_ACCURACY, executor)

    noisy_charge = clean_presses.noisy(case.noise, noise_seed)
    rng = np.random.default_rng(noise_seed)
    yield from _gain_mismatches(case, clean_presses.contact, noisy_charge, rng)
    yield from _dead_electrodes(case, clean_presses.contact, noisy_charge, rng)


def _solved_mismatch(
    group: str, name: str, other_case: EvaluationCase, accuracy: float, executor: Executor | None
) -> Mismatch:
    """Simulate presses with the sensor and the probes of another case, and return them as a mismatch.

    Args:
        group: Kind of the mismatch, such as "probe".
        name: Name of the mismatch within the group.
        other_case: Case whose sensor and probes differ.
        accuracy: Relative accuracy of the charges.
        executor: Executor of the simulations; None for this process.
    """
    forward_maps = other_case.forward_maps(accuracy=accuracy, executor=executor)
    presses = simulate_presses(forward_maps, other_case.test_sweep())
    charge = presses.noisy(other_case.noise, other_case.seed + MISMATCH_NOISE_SEED)
    return Mismatch(group, name, presses.contact, charge)


def _gain_mismatches(
    case: EvaluationCase, truth: Array, noisy_charge: Array, rng: np.random.Generator
) -> Iterator[Mismatch]:
    """Yield presses with random errors of all gains. Then yield, for each electrode, presses with only its gain wrong.

    The random errors are drawn separately for each press.

    Args:
        case: Case that contains the sensor.
        truth: Contacts, shape (n, 3), mm and N.
        noisy_charge: Charges with noise, shape (n, n_electrode), pC.
        rng: Random number generator.
    """
    random_gains = 1.0 + GAIN_STD * rng.standard_normal(noisy_charge.shape)
    yield Mismatch("gain", f"each off by {100 * GAIN_STD:g} % rms", truth, random_gains * noisy_charge)
    for electrode_index, name in enumerate(case.sensor.electrode_names):
        charge = noisy_charge.copy()
        charge[:, electrode_index] *= 1.0 + SINGLE_GAIN_ERROR
        yield Mismatch("gain", f"{name} off by {100 * SINGLE_GAIN_ERROR:g} %", truth, charge)


def _dead_electrodes(
    case: EvaluationCase, truth: Array, noisy_charge: Array, rng: np.random.Generator
) -> Iterator[Mismatch]:
    """Yield, for each electrode, presses in which this electrode measures only white noise.

    Args:
        case: Case that contains the sensor and the noise.
        truth: Contacts, shape (n, 3), mm and N.
        noisy_charge: Charges with noise, shape (n, n_electrode), pC.
        rng: Random number generator.
    """
    noise_charge = case.noise.white * rng.standard_normal(noisy_charge.shape)
    for electrode_index, name in enumerate(case.sensor.electrode_names):
        charge = noisy_charge.copy()
        charge[:, electrode_index] = noise_charge[:, electrode_index]
        yield Mismatch("dead electrode", f"{name} dead", truth, charge)


def measure_mismatch(
    mismatch: Mismatch,
    evaluated_name: str,
    evaluated_model: StoredModel,
    other_methods: Sequence[ComparedMethod],
    alarm_threshold: float,
) -> dict[str, Any]:
    """Measure the errors of the evaluated model and of other methods under a mismatch.

    The estimates of the other methods are clipped to the range from -`CLIP_LIMIT` to `CLIP_LIMIT`, because polynomials
    diverge for charges outside their training range.

    Args:
        mismatch: The presses with their charges.
        evaluated_name: Name of the evaluated model in the results.
        evaluated_model: The evaluated model.
        other_methods: Other fitted methods.
        alarm_threshold: Misfit above which the evaluated model gives an alarm, in standard deviations of the noise.

    Returns:
        One entry of "cases" in `report.json`. It contains the errors of each method. For the evaluated model, it also
        contains the percentage of presses with an alarm, and the fraction of the true values within one standard
        deviation of the estimate ("coverage_68").
    """
    estimate, std, misfit = evaluated_model.answer(mismatch.charge)
    errors = {evaluated_name: asdict(ContactErrors.compute(estimate, mismatch.truth))}
    for method in other_methods:
        with np.errstate(over="ignore"):  # a diverging polynomial may overflow
            method_estimate = method.regressor.predict(mismatch.charge)
        clipped_estimate = np.clip(method_estimate, -CLIP_LIMIT, CLIP_LIMIT)
        errors[method.name] = asdict(ContactErrors.compute(clipped_estimate, mismatch.truth))
    alarm_fraction = float(np.mean(misfit[:, 0] > alarm_threshold))
    inside_fraction = float(np.mean(np.abs(estimate - mismatch.truth) < std))
    return {
        "group": mismatch.group,
        "case": mismatch.name,
        "presses": len(mismatch.truth),
        "alarms_percent": round_significant(100.0 * alarm_fraction, 3),
        "coverage_68": round_significant(inside_fraction, 3),
        "errors": errors,
    }
