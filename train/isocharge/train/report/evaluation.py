"""Evaluation of a model and of all other methods on one dataset."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError, ModelError
from isocharge.common.progress import track
from isocharge.serve.benchmark import Contender, take_turns
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.predictor import Predictor
from isocharge.simulate import (
    ChargeSpline,
    Dataset,
    Domain,
    Probe,
    Samples,
    SolveSettings,
    Sweep,
    limits_at,
    noise_model,
    parse_probe,
)
from isocharge.simulate.dataset.sweep import solve_maps
from isocharge.simulate.mechanics.theory import ACCURACY
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.data.contact_errors import ContactErrorStatistics, rms
from isocharge.train.data.presses import LabelledPresses, check_enough, domain_of, held_out, is_measured, presses_of
from isocharge.train.model_release.evaluate import rounded
from isocharge.train.model_release.release import model_domain
from isocharge.train.report.methods import FittingTask, Method, fit_methods, model_method

NOISE = noise_model("reference")
"""Noise of simulated test presses, which also weights the charges of measured presses."""

TEST_SEED = 7919
"""Seed of the test presses and of their noise, relative to the seed of the settings, so that they differ from those of
a dataset."""

MIN_TRAINING_PRESSES = 30
"""Smallest number of measured presses that must remain for fitting after the test presses are held out."""

SINGLE_PRESSES = 64
"""Number of different presses that are predicted in turn when predictions are timed."""


@dataclass(frozen=True)
class Settings:
    """Settings of a report. The names of the attributes are keys of `report.json`.

    Attributes:
        presses: Number of simulated test presses.
        seconds: Duration for which the predictions of a method are timed, s.
        accuracy: Relative accuracy of the charges in the solves of the film.
        seed: Seed of all random numbers.
        quick: Whether the report is a trial run, whose results are not meaningful.
    """

    presses: int = 4096
    seconds: float = 0.1
    accuracy: float = ACCURACY
    seed: int = 0
    quick: bool = False


QUICK = Settings(presses=512, seconds=0.01, accuracy=1e-2, quick=True)
"""Settings for a trial run, which takes less than a minute."""


@dataclass(frozen=True)
class MethodRecord:
    """Results of the report for one method. The names of the attributes are keys of `report.json`.

    Attributes:
        name: Name of the method.
        library: Library that computes the estimates.
        answered: Fraction of the presses for which the method returned an estimate, 0 to 1.
        errors: Statistics of the errors on these presses, by the names of `ContactErrorStatistics`; empty if there are
            no such presses.
        single_press_us: Median duration of the estimate for one press, us.
    """

    name: str
    library: str
    answered: float
    errors: dict[str, float]
    single_press_us: float


@dataclass(frozen=True)
class Section:
    """Results of the evaluation on one dataset. The names of the attributes are keys of `report.json`.

    Attributes:
        sensor: Name of the sensor.
        measured: Whether the presses were measured.
        probes: Notations of the probes.
        radius_mm: Radius of the working area, mm.
        force_N: Smallest and largest force, N.
        noise: Name of the noise of the simulated test presses; None for measured presses.
        dataset_sha256: Checksum of the dataset.
        fitted_presses: Number of presses to which the methods were fitted.
        test_presses: Number of test presses.
        limits: Cramér-Rao limits of the errors on the test presses, by the names of the errors. They are empty for
            measured presses, because they need a simulation of exactly this film.
        methods: Records of the methods. The evaluated model is the first one.
        left_out: Reasons why other methods could not be fitted to measured presses.
    """

    sensor: str
    measured: bool
    probes: list[str]
    radius_mm: float
    force_N: tuple[float, float]
    noise: str | None
    dataset_sha256: str
    fitted_presses: int
    test_presses: int
    limits: dict[str, float]
    methods: list[MethodRecord]
    left_out: list[str]


@dataclass(frozen=True)
class DatasetEvaluation:
    """Prepared evaluation of a model and of all other methods on one dataset.

    Attributes:
        dataset: The dataset.
        model_folder: Version folder of the evaluated model.
        domain: Contacts that both the model and the dataset cover.
        presses: The presses to which the methods are fitted.
        held_out_presses: The test presses of a measured dataset; None if the test presses are simulated.
        probes: The probes of the dataset.
        is_rotated: Whether presses of a probe have several orientations.
        settings: Settings of the report.
    """

    dataset: Dataset
    model_folder: Path
    domain: Domain
    presses: LabelledPresses
    held_out_presses: LabelledPresses | None
    probes: tuple[Probe, ...]
    is_rotated: bool
    settings: Settings

    @classmethod
    def prepare(cls, dataset: Dataset, model_folder: Path, settings: Settings) -> "DatasetEvaluation":
        """Select the presses that the model covers, and hold out a part of measured presses for the test.

        Args:
            dataset: The dataset.
            model_folder: Version folder of the model.
            settings: Settings of the report.

        Returns:
            The evaluation, which has not started yet.

        Raises:
            DatasetError: If the methods cannot be fitted to the dataset.
            ModelError: If the model is for another sensor than the dataset.
            PressError: If there are too few measured presses.
        """
        model = Predictor(model_folder).metadata
        _check_same_sensor(model, dataset)

        trained_domain = model_domain(model)
        domain = _common_domain(trained_domain, domain_of(dataset))
        contact = LabelledPresses.of(dataset).contact
        is_covered = trained_domain.contains(contact) & domain.contains(contact)
        covered = replace(dataset, samples=dataset.samples[is_covered])
        held_out_presses = None
        if is_measured(dataset):
            check_enough(len(covered.samples), len(dataset.samples), dataset.sensor.name)
            all_presses = LabelledPresses.of(covered)
            is_held_out = held_out(all_presses.contact)
            held_out_presses = all_presses[is_held_out]
            remaining = replace(covered, samples=covered.samples[~is_held_out])
            presses = presses_of(remaining, MIN_TRAINING_PRESSES)
        else:
            presses = presses_of(covered)
        probes, is_rotated = _read_probes(covered.samples)
        return cls(
            dataset=covered,
            model_folder=model_folder,
            domain=domain,
            presses=presses,
            held_out_presses=held_out_presses,
            probes=probes,
            is_rotated=is_rotated,
            settings=settings,
        )

    def measure(self) -> Section:
        """Fit all methods, and measure their errors and their speed."""
        task = FittingTask(self.presses, self.domain, NOISE, seed=self.settings.seed)
        limits: dict[str, float] = {}
        if self.held_out_presses is None:
            task, test_presses, limits = self._simulate(task)
        else:
            test_presses = self.held_out_presses

        fitted_methods, failure_reasons = fit_methods(task)
        methods = [model_method(self.model_folder), *fitted_methods]
        return Section(
            sensor=self.dataset.sensor.name,
            measured=self.held_out_presses is not None,
            probes=[probe.notation for probe in self.probes],
            radius_mm=self.domain.radius,
            force_N=self.domain.force_range,
            noise=NOISE.name if self.held_out_presses is None else None,
            dataset_sha256=self.dataset.sha256,
            fitted_presses=len(self.presses),
            test_presses=len(test_presses),
            limits=limits,
            methods=measure_methods(methods, test_presses, self.settings.seconds),
            left_out=failure_reasons,
        )

    def _simulate(self, task: FittingTask) -> tuple[FittingTask, LabelledPresses, dict[str, float]]:
        """Simulate the charge map of the methods and the test presses, and compute the limits of the errors.

        The test presses have the distribution of the dataset but another seed. The charge map and the limits are those
        of the first probe.

        Args:
            task: Conditions of the fits without a charge map.

        Returns:
            The conditions with the charge map; the test presses with noise; and the Cramér-Rao limits of the errors, by
            the names of the errors.
        """
        settings = self.settings
        seed = settings.seed + TEST_SEED
        sweep = Sweep(
            radius=self.domain.radius,
            force_range=self.domain.force_range,
            samples=settings.presses - settings.presses % len(self.probes),  # the same number for each probe
            seed=seed,
            orientation="random" if self.is_rotated else "fixed",
        )
        forward_maps = solve_maps(self.dataset.sensor, self.probes, sweep, SolveSettings(accuracy=settings.accuracy))
        presses = sweep.over(self.probes)
        charge = np.empty((len(presses), self.presses.charge.shape[1]))
        for probe_index, forward_map in enumerate(forward_maps):
            rows = np.flatnonzero(presses.probe == probe_index)
            charge[rows] = forward_map.charges(presses.contact[rows], presses.rotation[rows])
        noisy_charge = NOISE.add(charge, np.random.default_rng(seed))

        charge_map = ChargeSpline.of(forward_maps[0])
        cramer_rao = limits_at(charge_map, presses.contact, NOISE)
        limits = {
            "position_rms_mm": rounded(rms(cramer_rao.position)),
            "position_median_mm": rounded(np.median(cramer_rao.position)),
            "force_rms_percent": rounded(100.0 * rms(cramer_rao.force)),
        }
        return replace(task, charge_map=charge_map), LabelledPresses(presses.contact, noisy_charge), limits


def _check_same_sensor(model: ModelMetadata, dataset: Dataset) -> None:
    """Raise an error if a model was not trained for the sensor of a dataset.

    For measured presses, the names of the electrodes must be equal, because a calibrated model has another film. For
    simulated presses, all values of the two sensors must be equal, except the names of the sensors.

    Args:
        model: Metadata of the model.
        dataset: The dataset.

    Raises:
        ModelError: If the sensors differ. The message names the values that differ.
    """
    names = dataset.sensor.electrode_names
    if is_measured(dataset):
        differences = [] if model.electrodes == names else [f"electrodes ({', '.join(model.electrodes)})"]
    else:
        expected = sensor_to_dict(dataset.sensor)
        keys = (expected.keys() | model.sensor.keys()) - {"name"}
        differences = sorted(key for key in keys if expected.get(key) != model.sensor.get(key))
    if differences:
        raise ModelError(
            f"model {model.label}: expected a model of the sensor {dataset.sensor.name!r} with the electrodes "
            f"{', '.join(names)}, got a model with another {', '.join(differences)}; choose a model of this sensor "
            "with --model, or train one"
        )


def _common_domain(first: Domain, second: Domain) -> Domain:
    """Return the contacts that two domains have in common: the smaller disk, and the common range of forces.

    Raises:
        DatasetError: If the ranges of forces have no common force.
    """
    min_force, max_force = np.clip(second.force_range, *first.force_range).tolist()
    if min_force >= max_force and second.force_range[0] < second.force_range[1]:
        raise DatasetError(
            f"expected presses with the forces of the model, {first.force_range[0]:g} to {first.force_range[1]:g} N, "
            f"got {second.force_range[0]:g} to {second.force_range[1]:g} N"
        )
    return Domain(min(first.radius, second.radius), (min_force, max_force))


def _read_probes(samples: Samples) -> tuple[tuple[Probe, ...], bool]:
    """Return the probes of a dataset, and whether the presses of any probe have several orientations.

    If all presses of a probe have the same angle, the probe is returned with this rotation.

    Args:
        samples: The presses of the dataset, each with the notation of its probe and its orientation.

    Raises:
        DatasetError: If the notation of a probe is not valid.
    """
    probes = []
    is_rotated = False
    for notation in np.unique(samples.probe):
        try:
            probe = parse_probe(str(notation))
        except ValueError as error:
            raise DatasetError(f"the probe {str(notation)!r} of the dataset: {error}") from error
        angles_deg = np.unique(samples.orientation_deg[samples.probe == notation])
        if len(angles_deg) == 1:
            probe = probe.rotated(float(np.deg2rad(angles_deg[0])))
        is_rotated |= len(angles_deg) > 1
        probes.append(probe)
    return tuple(probes), is_rotated


def measure_methods(methods: Sequence[Method], presses: LabelledPresses, seconds: float) -> list[MethodRecord]:
    """Measure the errors and the durations of all methods.

    The methods take turns in short periods of timing. If the speed of the machine changes, the change therefore affects
    all methods in the same way.

    Args:
        methods: The fitted methods.
        presses: The test presses, with the noise in their charges.
        seconds: Duration for which the predictions of a method are timed, s.

    Returns:
        The records of the methods, in the order of `methods`.
    """
    estimates = [method.estimate(presses.charge) for method in track(methods, "estimating contacts")]
    contenders = []
    for method in methods:
        calls = cycle([method.call_for(press_charge) for press_charge in presses.charge[:SINGLE_PRESSES]])
        contenders.append(Contender(method.name, 1, partial(_call_next, calls)))
    timings = take_turns(contenders, len(methods) * seconds)
    records = []
    for method, estimate, timing in zip(methods, estimates, timings, strict=True):
        answered, errors = contact_errors(estimate, presses.contact)
        records.append(MethodRecord(method.name, method.library, answered, errors, rounded(timing.p50_us)))
    return records


def contact_errors(estimate: Array, truth: Array) -> tuple[float, dict[str, float]]:
    """Compute the statistics of the errors of estimated contacts.

    Args:
        estimate: Estimated contacts (x, y, F), shape (n, 3), mm and N. Presses without an estimate are NaN.
        truth: True contacts (x, y, F), shape (n, 3), mm and N.

    Returns:
        The fraction of the presses with an estimate; and the statistics of the errors on these presses, by the names of
        `ContactErrorStatistics`. Without any estimate, there are no statistics.
    """
    has_estimate = np.isfinite(estimate).all(axis=1)
    if not has_estimate.any():
        return 0.0, {}
    statistics = ContactErrorStatistics.of(estimate[has_estimate], truth[has_estimate])
    return float(np.mean(has_estimate)), {name: rounded(value) for name, value in asdict(statistics).items()}


def _call_next(calls: Iterator[Callable[[], object]]) -> None:
    """Call the next function of an iterator."""
    next(calls)()
