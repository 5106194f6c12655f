"""Evaluation of a model and of all other methods on one dataset.

Every function in `METHOD_BUILDERS` adds a method to all reports. Models are added by their folders.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle
from pathlib import Path

import numpy as np
from msgspec import structs

from isocharge.common.arrays import Array
from isocharge.common.errors import DatasetError, ModelError, PressError, TrainingError
from isocharge.common.progress import track
from isocharge.serve.benchmark import Contender, take_turns
from isocharge.serve.model.contact import Contact, inside_polygon
from isocharge.serve.model.metadata import ModelMetadata
from isocharge.serve.model.predictor import Predictor
from isocharge.serve.model.session import COLUMNS
from isocharge.serve.presses.measured_presses import read_presses
from isocharge.simulate import ChargeMap, Dataset, NoiseModel, Triangulation, limits_at, noise_model
from isocharge.simulate.identifiability.nearest_contact import search
from isocharge.simulate.sensor.sensor_file import sensor_to_dict
from isocharge.train.calibration.folder import PRESSES
from isocharge.train.data.channel_noise import misfit_noise
from isocharge.train.data.charge_fit import fit_charge_series
from isocharge.train.data.contact_errors import contact_error_statistics, rms, rounded
from isocharge.train.data.presses import (
    MIN_PLACES,
    N_FOLDS,
    LabelledPresses,
    check_enough,
    have_charges_of,
    is_measured,
    presses_of,
    split_by_position,
)
from isocharge.train.training.config import TrainingConfig

N_CANDIDATES = 512
"""Number of contacts among which least squares chooses the starting points of its descents."""


@dataclass(frozen=True)
class FittingTask:
    """Charge map and noise to which a method is fitted.

    Attributes:
        charge_map: Map from contacts to charges that is fitted to the presses of the dataset. Its domain contains the
            contacts that can occur.
        noise: Noise of the charges when the method is used.
    """

    charge_map: ChargeMap
    noise: NoiseModel


@dataclass(frozen=True)
class Method:
    """A fitted method.

    Attributes:
        name: Name in the table and in the picture.
        library: Library that computes the estimates.
        estimate: Function that converts charges, shape (n, n_electrode), pC, to contacts (x, y, F), shape (n, 3), mm
            and N. If there is no estimate for a press, the contact is NaN.
        single_call: Function that takes the charges of one press, shape (n_electrode,), pC, and returns another
            function. The returned function has no arguments, and estimates the contact of this press. None if
            `estimate` is the fastest way to estimate one contact.
    """

    name: str
    library: str
    estimate: Callable[[Array], Array]
    single_call: Callable[[Array], Callable[[], object]] | None = None

    def call_in_turn(self, charge: Array) -> Callable[[], object]:
        """Return a function without arguments. Each call of the function estimates the contact of the next press.

        This method estimates nothing itself. The duration of the calls of the returned function is measured. After the
        last press, the function begins again with the first press.

        Args:
            charge: Charges of the presses, shape (n, n_electrode), pC.
        """
        if self.single_call is not None:
            calls = [self.single_call(press_charge) for press_charge in charge]
        else:
            calls = [partial(self.estimate, press_charge[None]) for press_charge in charge]
        calls_in_turn = cycle(calls)
        return lambda: next(calls_in_turn)()  # take the next function, and call it


def triangulation(task: FittingTask) -> Method:
    """Return the triangulation of the paper, which intersects the contours of the charges."""
    contours = Triangulation(task.charge_map)
    return Method("triangulation", "NumPy", lambda charge: contours.locate(charge).contact)


def least_squares(task: FittingTask) -> Method:
    """Return the search for the contact with the smallest squared residuals of the charges.

    The residuals are divided by the standard deviation of the noise. The contact is restricted to the domain.
    """
    return Method(
        "least squares, Gauss-Newton",
        "NumPy",
        lambda charge: search(task.charge_map, charge, task.noise.sigma(charge), candidates=N_CANDIDATES)[0],
    )


METHOD_BUILDERS: tuple[Callable[[FittingTask], Method], ...] = (triangulation, least_squares)
"""Functions that fit the methods of all reports. A function raises TrainingError if there are too few presses."""


def model_method(predictor: Predictor) -> Method:
    """Return the method that estimates contacts with the network of a model."""

    def single_call(charge: Array) -> Callable[[], object]:
        """Return a function that computes the complete answer to one press."""
        # Every call writes its answer into this array. Only the duration of the calls matters.
        answer_buffer = np.zeros(len(Contact._fields), np.float32)
        return partial(predictor.predict_into, charge.astype(np.float32), answer_buffer)

    # The arguments are the name and the library of the method, its function for many presses, and its function for one.
    return Method(
        f"network `{predictor.metadata.label}`",
        "Predictor",
        lambda charge: np.asarray(predictor.predict_batch(charge), float)[:, COLUMNS["contact"]],
        single_call,
    )


SEED = 0
"""Seed of all random numbers."""

SINGLE_PRESSES = 64
"""Number of different presses that are predicted in turn when predictions are timed."""


@dataclass(frozen=True)
class Settings:
    """Settings of a report. The names of the attributes are keys of `report.json`.

    Attributes:
        presses: Smallest number of simulated test presses. If there are fewer presses, they are repeated with other
            noise.
        seconds: Duration for which the predictions of a method are timed, s.
        quick: Whether the report is a trial run, whose results are not meaningful.
    """

    presses: int = 4096
    seconds: float = 0.1
    quick: bool = False


QUICK = Settings(presses=512, seconds=0.01, quick=True)
"""Settings for a trial run, which takes less than a minute."""


@dataclass(frozen=True)
class MethodRecord:
    """Results of the report for one method. The names of the attributes are keys of `report.json`.

    Attributes:
        name: Name of the method.
        library: Library that computes the estimates.
        answered: Fraction of the presses for which the method returned an estimate, 0 to 1.
        errors: Statistics of the errors on the presses with an estimate, by the names of `contact_error_statistics`;
            empty if no press has an estimate.
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
        limits: Cramér-Rao limits of the rms errors on the test presses, by the names of the errors. There are no limits
            for measured presses, whose noise is unknown, or without a charge map.
        methods: Records of the methods. The evaluated model is the first method.
        left_out: Reasons why other methods or the limit could not be computed.
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


def evaluate_dataset(dataset: Dataset, model_folder: Path, settings: Settings) -> Section:
    """Measure the errors and the speed of a model and of all other methods on one dataset.

    Args:
        dataset: The dataset.
        model_folder: Version folder of the model.
        settings: Settings of the report.

    Raises:
        DatasetError: If the methods cannot be fitted to the dataset.
        ModelError: If the model and the dataset are for different sensors.
        PressError: If there are too few measured presses, or the model was calibrated from all presses that are held
            out.
    """
    predictor = Predictor(model_folder)
    model = predictor.metadata
    check_same_sensor(model, dataset)
    covered_dataset = _covered_presses(dataset, model)
    fit_presses, test = split_presses(covered_dataset, model_folder, model)
    domain = LabelledPresses.of(covered_dataset.samples).domain
    measured = is_measured(dataset)
    # The noise of the training determines the weights of the charges in a fit. The noise is added only to simulated
    # presses, because the charges of measured presses already contain noise. That noise is unknown.
    noise = noise_of(model)
    if not measured:  # `settings.presses` is the smallest number of test presses
        repeated_test = test.repeated(settings.presses)
        test = replace(repeated_test, charge=repeated_test.noisy(noise, SEED))

    # Fit the other methods. With too few presses, the fit of the series or of a method raises TrainingError, and the
    # report states the reason. `omissions` lists the reasons why methods or the Cramér-Rao limit are left out.
    methods = [model_method(predictor)]
    cramer_rao_limits: dict[str, float] = {}
    omissions = []
    try:
        train, validation = split_by_position(fit_presses, TrainingConfig().hold_out)
        charge_map = fit_charge_series(domain, dataset.sensor.electrode_names, train, validation, noise.white)
        task = FittingTask(charge_map, noise)
        methods += [build_method(task) for build_method in METHOD_BUILDERS]

        # Compute the Cramér-Rao limit from the derivatives of the series. The noise of measured presses is unknown.
        if not measured:
            series_error_pC = charge_map.charges(validation.contact) - validation.charge
            if rms(series_error_pC / noise.sigma(validation.charge)) < 1.0:  # the error is smaller than the noise
                cramer_rao = limits_at(charge_map, test.contact, noise)
                cramer_rao_limits = {
                    "position_rms_mm": rounded(rms(cramer_rao.position)),
                    "force_rms_percent": rounded(100.0 * rms(cramer_rao.force)),
                }
            else:
                omissions.append(
                    f"Cramér-Rao limit: a series that is fitted to {len(train)} presses has an error of "
                    f"{100.0 * charge_map.charge_std:.2g} % of a charge, more than the noise; simulate more presses"
                )
    except TrainingError as error:
        omissions.append(str(error))
    return Section(
        sensor=dataset.sensor.name,
        measured=measured,
        probes=list(covered_dataset.samples.probes),
        radius_mm=domain.radius,
        force_N=domain.force_range,
        noise=None if measured else noise.name,
        dataset_sha256=dataset.sha256,
        fitted_presses=len(fit_presses),
        test_presses=len(test),
        limits=cramer_rao_limits,
        methods=measure_methods(methods, test, settings.seconds),
        left_out=omissions,
    )


def _covered_presses(dataset: Dataset, model: ModelMetadata) -> Dataset:
    """Select the presses in the working area and in the range of forces of a model.

    Raises:
        DatasetError: If there are no such presses.
        PressError: If there are too few measured presses.
    """
    samples = dataset.samples
    min_force, max_force = model.force_range_N
    is_covered = inside_polygon(samples.x_mm, samples.y_mm, np.array(model.working_area_mm))
    is_covered &= (samples.force_N >= min_force) & (samples.force_N <= max_force)
    if not is_covered.any():
        raise DatasetError(
            f"expected presses in the working area of the model {model.label} and of its forces, {min_force:g} to "
            f"{max_force:g} N, got none among {len(samples)} presses; choose another model with --model"
        )
    covered_samples = samples[is_covered]
    if is_measured(dataset):
        check_enough(len(covered_samples), len(samples), dataset.sensor.name)
    return replace(dataset, samples=covered_samples)


def split_presses(
    dataset: Dataset, model_folder: Path, model: ModelMetadata
) -> tuple[LabelledPresses, LabelledPresses]:
    """Split presses into presses to which methods are fitted, and presses that are held out for the test.

    In a simulated dataset, a tenth of the positions is held out. A training on the same dataset holds out the same
    positions. If the configuration of the training states a smaller share, the training holds out only some of these
    positions. The test uses only positions that neither the report nor the training uses for fitting. Measured datasets
    are smaller. In a measured dataset, a fifth of the positions is held out, except presses that a calibration of the
    model has used.

    Args:
        dataset: The presses of a dataset that the model covers.
        model_folder: Version folder of the model.
        model: Metadata of the model. The entry `config` of `made_with` contains the settings of its training.

    Raises:
        DatasetError: If the methods cannot be fitted to the dataset.
        PressError: If the model was calibrated from all presses that are held out.
    """
    if not is_measured(dataset):
        hold_out = TrainingConfig().hold_out  # a tenth
        # Was the model trained on this dataset? The metadata of a network of another program contain no settings.
        if model.dataset_sha256 == dataset.sha256 and "config" in model.made_with:
            # The positions of a smaller share are also held out with a larger share.
            hold_out = min(hold_out, model.made_with["config"]["training"]["hold_out"])
        return split_by_position(presses_of(dataset), hold_out)

    # A measured dataset needs at least `MIN_PLACES` presses. A fifth is held out.
    presses, held_out = split_by_position(presses_of(dataset, MIN_PLACES), 1.0 / N_FOLDS)
    is_learned = have_charges_of(held_out.charge, _calibration_charges(model_folder, model))
    if is_learned.all():
        raise PressError(
            f"expected held-out presses that the model {model.label} has not learned, got only presses of its "
            "calibrations; measure more presses"
        )
    return presses, held_out[~is_learned]


def noise_of(model: ModelMetadata) -> NoiseModel:
    """Return the noise for which a model was trained.

    The noise `reference` is returned for a model that was trained without noise, or with measured noise, which has
    different parameters for each electrode.
    """
    name, white_pC, gain = structs.astuple(model.noise)
    if isinstance(white_pC, tuple) or isinstance(gain, tuple):
        return noise_model("reference")
    return misfit_noise(NoiseModel(name, white_pC, gain))


def _calibration_charges(model_folder: Path, model: ModelMetadata) -> Array:
    """Return the charges of all presses from which a model was calibrated, shape (n, n_electrode), pC.

    A calibration may continue an earlier calibration, so the presses of all versions of the model are returned. A model
    that was not calibrated has no such presses.
    """
    files = model_folder.parent.glob(f"*/{PRESSES}")  # of all versions
    charges = [read_presses(file, model.electrodes).charge_pC for file in files]
    # The empty array is the result for a model that was not calibrated.
    return np.concatenate([np.empty((0, len(model.electrodes))), *charges])


def check_same_sensor(model: ModelMetadata, dataset: Dataset) -> None:
    """Raise an error if a model was not trained for the sensor of a dataset.

    For measured presses, only the names of the electrodes and their order are compared, because a calibration changes
    the film. A model that was trained only on measured presses is refused, because it may have learned from the presses
    on which it would be tested. For simulated presses, all values of the two sensors must be equal, except the names of
    the sensors.

    Args:
        model: Metadata of the model.
        dataset: The dataset.

    Raises:
        ModelError: If the sensors differ, or if the model was trained only on measured presses. The message names the
            values that differ.
    """
    names = dataset.sensor.electrode_names
    differences = [] if model.electrodes == names else [f"electrodes ({', '.join(model.electrodes)})"]
    if not is_measured(dataset):
        expected = sensor_to_dict(dataset.sensor)
        keys = (expected.keys() | model.sensor.keys()) - {"name"}
        differences += sorted(key for key in keys if expected.get(key) != model.sensor.get(key))
    elif "film" not in model.sensor:  # trained only on measured presses
        raise ModelError(
            f"model {model.label}: expected a model of a film, got a model of presses alone, which has learned from "
            "all presses; its card states its errors on held-out presses"
        )
    if differences:
        raise ModelError(
            f"model {model.label}: expected a model of the sensor {dataset.sensor.name!r} with the electrodes "
            f"{', '.join(names)}, got a model with another {', '.join(differences)}; choose a model of this sensor "
            "with --model, or train one"
        )


def measure_methods(methods: Sequence[Method], presses: LabelledPresses, seconds: float) -> list[MethodRecord]:
    """Measure the errors and the durations of all methods.

    The methods take turns in short periods of timing. If the speed of the machine changes, the change therefore affects
    all methods in the same way. The errors are those on the presses for which a method has an estimate.

    Args:
        methods: The fitted methods.
        presses: The test presses, with the noise in their charges.
        seconds: Duration for which the predictions of a method are timed, s.

    Returns:
        The records of the methods, in the order of `methods`.
    """
    timed_charge = presses.charge[:SINGLE_PRESSES]
    # Each call estimates one press.
    contenders = [Contender(method.name, 1, method.call_in_turn(timed_charge)) for method in methods]
    timings = take_turns(contenders, len(methods) * seconds)
    records = []
    for method, timing in zip(track(methods, "estimating contacts"), timings, strict=True):
        estimate = method.estimate(presses.charge)
        is_answered = np.isfinite(estimate).all(axis=1)  # a press without an estimate has the contact NaN
        errors = {}
        if is_answered.any():
            errors = contact_error_statistics(estimate[is_answered], presses.contact[is_answered])
        answered_share = float(np.mean(is_answered))
        records.append(MethodRecord(method.name, method.library, answered_share, errors, rounded(timing.p50_us)))
    return records
