"""Evaluation of a model and of all other methods on one dataset."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from isocharge.common.progress import track
from isocharge.serve import Predictor
from isocharge.simulate import ChargeSpline, Dataset, ForwardMap
from isocharge.simulate.plots.figure import save_picture
from isocharge.train.baselines.compared_methods import (
    BOOSTING,
    GAUSS_NEWTON,
    LINEAR_BAND,
    POLYNOMIAL,
    TABLE,
    ComparedMethod,
    FittingTask,
    compared_methods,
)
from isocharge.train.baselines.networks import EVALUATED_MODEL, StoredModel, TrainedNetwork
from isocharge.train.data.presses import LabelledPresses, held_out, is_measured, presses_of, split_by_position
from isocharge.train.model_release.evaluate import alarm_threshold
from isocharge.train.report import pictures, studies
from isocharge.train.report.case import BAYES, ErrorLimits, EvaluationCase, Settings, simulate_presses
from isocharge.train.report.measures import compare_with_evaluated_model, round_significant
from isocharge.train.report.methods import FittedMethod, fit_all, measure_methods
from isocharge.train.report.press_selection import measured_presses_for, select_presses, simulated_presses_for
from isocharge.train.training.source import TrainingData

STUDIED_METHODS = (GAUSS_NEWTON, POLYNOMIAL, TABLE, BOOSTING, LINEAR_BAND)
"""Names of the methods that are studied in more detail, in addition to the evaluated model."""

TEST_NOISE_SEED = 4242
"""Seed of the noise on the test presses, relative to the seed of the case."""

MIN_TRAINING_PRESSES = 30
"""Smallest number of measured presses that must remain for fitting after the test presses are held out."""

PICTURE_FORMATS = ("png", "svg")
"""File formats in which each picture is saved. The page shows the file in the first format."""

DrawPicture = Callable[[], Figure]
"""Function without arguments that draws a picture."""


@dataclass(frozen=True)
class Section:
    """Results of the evaluation on one dataset.

    Attributes:
        content: Entries of the dataset in `report.json`, except the names of the pictures. The methods are
            `MethodRecord` objects.
        drawings: Functions that draw the pictures of the section, by the name of the picture.
    """

    content: dict[str, Any]
    drawings: dict[str, DrawPicture]

    def save_pictures(self, folder: Path, file_stem: str) -> dict[str, list[str]]:
        """Draw all pictures of the section, and save them.

        Args:
            folder: Folder of the pictures.
            file_stem: First part of the file names.

        Returns:
            The names of the files of each picture, by the name of the picture.
        """
        files_by_picture = {}
        for name, draw in track(self.drawings.items(), "drawing"):
            files = [f"{file_stem}-{name}.{extension}" for extension in PICTURE_FORMATS]
            figure = draw()
            for file in files:
                save_picture(figure, folder / file)
            files_by_picture[name] = files
        return files_by_picture


@dataclass(frozen=True)
class DatasetEvaluation:
    """Prepared evaluation of a model and of all other methods on one dataset.

    Attributes:
        dataset: The presses for fitting and validation.
        evaluated_model: The model that is evaluated. It may be a released model or a model of the user.
        students: Version folders of the small models of the same sensor.
        task: The presses and conditions to which the methods are fitted.
        case: The conditions of the test.
        settings: Settings of the report.
        held_out_presses: The test presses of a measured dataset; None if the test presses are simulated.
    """

    dataset: Dataset
    evaluated_model: StoredModel
    students: tuple[Path, ...]
    task: FittingTask
    case: EvaluationCase
    settings: Settings
    held_out_presses: LabelledPresses | None = None

    @classmethod
    def prepare(
        cls, dataset: Dataset, model_folder: Path, students: Sequence[Path], settings: Settings
    ) -> "DatasetEvaluation":
        """Select the presses on which the model can be evaluated, and split them for fits and tests.

        Measured presses are split into three groups: for training, for the choice of parameters (validation), and for
        the test (held out). Simulated presses are only split into the first two groups, because the test presses are
        simulated later.

        Args:
            dataset: The dataset.
            model_folder: Version folder of the model.
            students: Version folders of small models; models of other sensors are ignored.
            settings: Settings of the report.

        Returns:
            The evaluation, which has not started yet.

        Raises:
            DatasetError: If the methods cannot be fitted to the dataset.
            ModelError: If the model is for another sensor or for a smaller range of forces than the dataset.
            PressError: If there are too few measured presses.
        """
        # Read the evaluated model, and find the small models of the same sensor.
        model = Predictor(model_folder).metadata
        unique_students = dict.fromkeys(students)  # without repetitions, in the given order
        own_students = tuple(path for path in unique_students if Predictor(path).metadata.sensor == model.sensor)

        # Select the presses within the working area and the range of forces of the model.
        select_for_model = measured_presses_for if is_measured(dataset) else simulated_presses_for
        usable_dataset = select_for_model(model, dataset)
        case = EvaluationCase.for_dataset(usable_dataset, settings.presses, settings.seed)

        # Separate the test presses from the presses for the fits.
        held_out_presses = None
        if is_measured(dataset):
            all_presses = LabelledPresses.of(usable_dataset)
            is_held_out = held_out(all_presses.contact)
            held_out_presses = all_presses[is_held_out]
            fitting_dataset = _first_presses(select_presses(usable_dataset, ~is_held_out), settings.learn_from)
            fitting_presses = presses_of(fitting_dataset, MIN_TRAINING_PRESSES)
        else:
            fitting_dataset = _first_presses(usable_dataset, settings.learn_from)
            fitting_presses = presses_of(fitting_dataset)

        # Separate the validation presses from the training presses.
        train, validation = split_by_position(fitting_presses, settings.hold_out, settings.seed)
        task = FittingTask(
            train, validation, domain=case.domain, noise=case.noise, seed=settings.seed, quick=settings.quick
        )
        return cls(fitting_dataset, StoredModel(model_folder), own_students, task, case, settings, held_out_presses)

    def identity(self) -> dict[str, Any]:
        """Return the checksum of the dataset and the folders of the models.

        A stopped report is continued only if these values are the same.
        """
        folders = [self.evaluated_model.folder, *self.students]
        return {"dataset_sha256": self.dataset.sha256, "models": [str(folder) for folder in folders]}

    def measure(self, executor: Executor) -> Section:
        """Fit all methods, measure their errors and costs, and prepare the plots of the error against each cost.

        Args:
            executor: Executor of the simulations of the film and of the integrals of the Bayes limit.

        Returns:
            The results with the functions that draw their pictures.
        """
        if self.held_out_presses is None:
            section = self._measure_on_simulated_presses(executor)
        else:
            section = self._measure_on_measured_presses(self.held_out_presses)

        records = section.content["methods"]
        limits_mm = pictures.limit_errors(section.content["limits"])
        drawings = dict(section.drawings)
        for cost in pictures.COST_LABELS:
            drawings[cost] = partial(pictures.cost_plot, records, cost, limits_mm)
        return Section(section.content, drawings)

    def _measure_on_simulated_presses(self, executor: Executor) -> Section:
        """Simulate test presses, evaluate all methods on them, and return the section of a simulated dataset.

        The test presses are simulated first, and the theoretical limits of the error are computed for these presses.
        All methods are then fitted and measured. Finally, the evaluated model is studied for several draws of the noise
        and for mismatches, which are conditions that differ from the assumptions of the model.

        Args:
            executor: Executor of the simulations of the film and of the integrals of the Bayes limit.
        """
        case = self.case
        settings = self.settings

        # Simulate the test presses. Except in a quick report, the film is solved again for them, so that the errors of
        # the solutions are not the same as in the theoretical limits.
        forward_maps = case.forward_maps(range_factor=1.0, accuracy=settings.accuracy, executor=executor)
        test_maps = self._test_maps(forward_maps, executor)
        clean_presses = simulate_presses(test_maps, case.test_sweep())
        noisy_charge = clean_presses.noisy(case.noise, case.seed + TEST_NOISE_SEED)
        test_presses = replace(clean_presses, charge=noisy_charge)

        # Compute the theoretical limits: the Cramér-Rao limit of all presses, and the Bayes limit of the first presses.
        charge_map = ChargeSpline.of(forward_maps[0])
        limits = ErrorLimits.compute(case, charge_map, clean_presses, noisy_charge[: settings.limited], executor)

        # Fit and measure the methods. On simulated presses, a method that cannot be fitted raises an error, so there
        # are no failures to report.
        methods = [*self._stored_models(), *compared_methods(self.task, charge_map), *self._new_networks()]
        fitted_methods, _ = fit_all(methods, self.task, test_presses)
        fitted_by_name = {fitted.method.name: fitted for fitted in fitted_methods}
        records = measure_methods(fitted_methods, test_presses, settings, limits.posterior_mean)

        # Study the evaluated model for several draws of the noise, and all studied methods for mismatches.
        noise_draws = studies.NoiseDraws.draw(self.evaluated_model, clean_presses, case, settings.draws)
        threshold = alarm_threshold(noise_draws.misfit)
        content = {
            **self._description(len(test_presses)),
            "limits": limits.to_dict(test_presses.contact),
            "methods": records,
            "verdict": compare_with_evaluated_model(records),
            "by_force": self._errors_by_force(fitted_by_name, limits, test_presses),
            "calibration": studies.coverage_by_level(noise_draws),
            "alarm_threshold": round_significant(threshold),
            "cases": self._mismatch_results(fitted_by_name, clean_presses, threshold, executor),
        }
        return Section(content, _study_drawings(content, case, noise_draws))

    def _test_maps(self, forward_maps: tuple[ForwardMap, ...], executor: Executor) -> tuple[ForwardMap, ...]:
        """Return the forward maps from which the charges of the test presses are computed.

        A quick report uses the given maps. For a full report, the film is solved again, with slightly larger ranges of
        distances and forces.

        Args:
            forward_maps: Forward maps with which the theoretical limits are computed.
            executor: Executor of the simulations of the film.
        """
        if self.settings.quick:
            return forward_maps
        return self.case.forward_maps(executor=executor)

    def _errors_by_force(
        self, fitted_by_name: Mapping[str, FittedMethod], limits: ErrorLimits, test: LabelledPresses
    ) -> dict[str, Any]:
        """Compute the position error of some methods and of the theoretical limits in each bin of the force.

        The methods are the evaluated model and the methods of `STUDIED_METHODS`. The Bayes limit is left out if it was
        not computed.

        Args:
            fitted_by_name: Fitted methods by name.
            limits: Theoretical limits of the errors.
            test: The test presses.

        Returns:
            Errors by the name of the method; see `studies.errors_by_force`.
        """
        estimates = {}
        if limits.posterior_mean is not None:
            estimates[BAYES] = limits.posterior_mean
        for name in (EVALUATED_MODEL, *STUDIED_METHODS):
            estimates[name] = fitted_by_name[name].estimate
        return studies.errors_by_force(self.case.domain, test.contact, estimates, limits.cramer_rao.position)

    def _mismatch_results(
        self,
        fitted_by_name: Mapping[str, FittedMethod],
        clean_presses: LabelledPresses,
        threshold: float,
        executor: Executor,
    ) -> list[dict[str, Any]]:
        """Measure the errors of the evaluated model and of the studied methods for all mismatches.

        A mismatch is a condition that differs from the assumptions of the models, such as another probe.

        Args:
            fitted_by_name: Fitted methods by name.
            clean_presses: The test presses without noise.
            threshold: Misfit above which the evaluated model gives an alarm, in standard deviations of the noise.
            executor: Executor of the simulations of the film.

        Returns:
            The results of `studies.measure_mismatch`, one for each mismatch.
        """
        methods = [fitted_by_name[name].method for name in STUDIED_METHODS]
        return [
            studies.measure_mismatch(mismatch, EVALUATED_MODEL, self.evaluated_model, methods, threshold)
            for mismatch in studies.mismatches(self.case, clean_presses, self.settings, executor)
        ]

    def _measure_on_measured_presses(self, test: LabelledPresses) -> Section:
        """Evaluate all methods on measured presses, and return the section of the dataset.

        The section contains no results that need a simulation of the film.

        Args:
            test: The held-out presses.
        """
        methods = [*self._stored_models(), *compared_methods(self.task), *self._new_networks()]
        fitted_methods, failure_reasons = fit_all(methods, self.task, test)
        records = measure_methods(fitted_methods, test, self.settings)
        content = {
            **self._description(len(test)),
            "limits": {"bayes": None, "cramer_rao": None},
            "methods": records,
            "verdict": compare_with_evaluated_model(records),
            "left_out": failure_reasons,
        }
        return Section(content, {})

    def _stored_models(self) -> list[ComparedMethod]:
        """Return the evaluated model and its students, which are small models of the same sensor.

        Each model is listed twice: with all outputs, and with the contact as its only output. The evaluated model with
        all outputs comes first.
        """
        models = {EVALUATED_MODEL: self.evaluated_model}
        for path in self.students:
            student_name = Predictor(path).metadata.name
            models[student_name] = StoredModel(path)

        methods = []
        for name, model in models.items():
            full_model = ComparedMethod(name, "network", "Predictor", model, choice="not fitted again")
            contact_model = ComparedMethod(
                f"{name}, contact only",
                "network",
                "ONNX Runtime, bound",
                model.contact_only(),
                choice="not fitted again, only the contact",
            )
            methods += [full_model, contact_model]
        return methods

    def _new_networks(self) -> list[ComparedMethod]:
        """Return one untrained network for each size in the settings."""
        case = self.case
        steps = self.settings.steps
        data = TrainingData(
            sensor=case.sensor,
            probes=tuple(probe.notation for probe in case.probes),
            domain=case.domain,
            presses=self.task.train,
            sha256=self.dataset.sha256,
        )
        methods = []
        for widths in self.settings.sizes:
            widths_text = "-".join(str(width) for width in widths)
            name = f"network {widths_text}"
            network = TrainedNetwork(data, widths, steps, case.noise, self.settings.seed)
            methods.append(ComparedMethod(name, "network", "ONNX Runtime, bound", network, choice=f"{steps} steps"))
        return methods

    def _description(self, test_count: int) -> dict[str, Any]:
        """Return the entries of the section that describe the dataset, the conditions of the test, and the model.

        Args:
            test_count: Number of test presses.
        """
        case = self.case
        model = self.evaluated_model.predictor.metadata
        return {
            "sensor": case.sensor.name,
            "measured": self.held_out_presses is not None,
            "electrodes": list(case.sensor.electrode_names),
            "probes": [probe.notation for probe in case.probes],
            "radius_mm": case.domain.radius,
            "force_N": list(case.domain.force_range),
            "noise": case.noise.to_dict(),
            "dataset_sha256": self.dataset.sha256,
            "presses": {"train": len(self.task.train), "validation": len(self.task.validation), "test": test_count},
            "model": {
                "label": model.label,
                "probes": list(model.probes),
                "noise": model.noise.name,
                "dataset_sha256": model.dataset_sha256,
                "card_errors": dict(model.errors),
            },
        }


def _first_presses(dataset: Dataset, max_presses: int) -> Dataset:
    """Return a dataset with the first `max_presses` presses of a dataset, or with all presses if there are fewer."""
    is_first = np.arange(len(dataset.samples)) < max_presses
    return select_presses(dataset, is_first)


def _study_drawings(
    content: Mapping[str, Any], case: EvaluationCase, draws: studies.NoiseDraws
) -> dict[str, DrawPicture]:
    """Return the functions that draw the pictures of the studies, by the name of the picture.

    In the section, the mismatches of the noise have the same order as `studies.NOISE_FACTORS`. The errors of each
    method can therefore be drawn against these factors.

    Args:
        content: Section of the report of a simulated dataset.
        case: The conditions of the test.
        draws: Estimates of the evaluated model under several noise draws.
    """
    by_force = content["by_force"]
    mismatch_results = content["cases"]
    evaluated_record = content["methods"][0]  # the evaluated model is always listed first
    nominal_error_mm = evaluated_record.errors.position_rms_mm

    noise_results = [result for result in mismatch_results if result["group"] == "noise"]
    method_names = noise_results[0]["errors"].keys()
    noise_errors_by_method = {}
    for name in method_names:
        noise_errors_by_method[name] = [result["errors"][name]["position_rms_mm"] for result in noise_results]
    return {
        "maps": partial(pictures.error_maps, case.sensor, case.domain, draws),
        "force": partial(pictures.error_lines, by_force["force_N"], by_force["position_rms_mm"], "force, N"),
        "calibration": partial(pictures.coverage_plot, content["calibration"]),
        "noise": partial(
            pictures.error_lines,
            studies.NOISE_FACTORS,
            noise_errors_by_method,
            "noise, relative to the reference noise",
        ),
        "effects": partial(pictures.mismatch_plot, mismatch_results, nominal_error_mm),
    }
