"""Evaluation of a model and of all other methods on one dataset."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from isocharge.serve.model.predictor import Predictor
from isocharge.simulate import ChargeSpline, Dataset, limits_at
from isocharge.train.data.contact_errors import rms
from isocharge.train.data.presses import LabelledPresses, held_out, is_measured, presses_of
from isocharge.train.report.case import TEST_RANGE_FACTOR, EvaluationCase, Settings, simulate_presses
from isocharge.train.report.measures import MethodRecord, measure_methods, round_significant
from isocharge.train.report.methods import FittingTask, fit_methods, model_method
from isocharge.train.report.press_selection import measured_presses_for, select_presses, simulated_presses_for

TEST_NOISE_SEED = 4242
"""Seed of the noise on the test presses, relative to the seed of the case."""

MIN_TRAINING_PRESSES = 30
"""Smallest number of measured presses that must remain for fitting after the test presses are held out."""


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
        dataset_sha256: Checksum of the dataset.
        models: Version folders of the evaluated model and of the small models of the same sensor.
        presses: The presses to which the methods are fitted.
        held_out_presses: The test presses of a measured dataset; None if the test presses are simulated.
        case: The conditions of the test.
        settings: Settings of the report.
    """

    dataset_sha256: str
    models: tuple[Path, ...]
    presses: LabelledPresses
    held_out_presses: LabelledPresses | None
    case: EvaluationCase
    settings: Settings

    @classmethod
    def prepare(
        cls, dataset: Dataset, model_folder: Path, students: Sequence[Path], settings: Settings
    ) -> "DatasetEvaluation":
        """Select the presses on which the model can be evaluated, and hold out a part of measured presses for the test.

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
        model = Predictor(model_folder).metadata
        own_students = [path for path in students if Predictor(path).metadata.sensor == model.sensor]
        models = tuple(dict.fromkeys([model_folder, *own_students]))  # without repetitions

        # Use only the presses within the working area and the range of forces of the model.
        held_out_presses = None
        if is_measured(dataset):
            usable_dataset = measured_presses_for(model, dataset)
            all_presses = LabelledPresses.of(usable_dataset)
            is_held_out = held_out(all_presses.contact)
            held_out_presses = all_presses[is_held_out]
            presses = presses_of(select_presses(usable_dataset, ~is_held_out), MIN_TRAINING_PRESSES)
        else:
            usable_dataset = simulated_presses_for(model, dataset)
            presses = presses_of(usable_dataset)
        case = EvaluationCase.for_dataset(usable_dataset, settings.presses, settings.seed)
        return cls(dataset.sha256, models, presses, held_out_presses, case, settings)

    def measure(self) -> Section:
        """Fit all methods, and measure their errors and their speed."""
        case = self.case
        task = FittingTask(self.presses, case.domain, case.noise, seed=self.settings.seed)
        limits: dict[str, float] = {}
        if self.held_out_presses is None:
            task, test_presses, limits = self._simulate(task)
        else:
            test_presses = self.held_out_presses

        fitted_methods, failure_reasons = fit_methods(task)
        methods = [*map(model_method, self.models), *fitted_methods]
        records = measure_methods(methods, test_presses, self.settings.batch, self.settings.seconds)
        return Section(
            sensor=case.sensor.name,
            measured=self.held_out_presses is not None,
            probes=[probe.notation for probe in case.probes],
            radius_mm=case.domain.radius,
            force_N=case.domain.force_range,
            noise=case.noise.name if self.held_out_presses is None else None,
            dataset_sha256=self.dataset_sha256,
            fitted_presses=len(self.presses),
            test_presses=len(test_presses),
            limits=limits,
            methods=records,
            left_out=failure_reasons,
        )

    def _simulate(self, task: FittingTask) -> tuple[FittingTask, LabelledPresses, dict[str, float]]:
        """Simulate the charge map of the methods and the test presses, and compute the limits of the errors.

        Except in a quick report, the film is solved again for the test presses, so that the errors of the charge map
        are not the same as those of the test presses. The charge map and the limits are those of the first probe.

        Args:
            task: Conditions of the fits without a charge map.

        Returns:
            The conditions with the charge map; the test presses with noise; and the Cramér-Rao limits of the errors, by
            the names of the errors.
        """
        case = self.case
        settings = self.settings
        forward_maps = case.forward_maps(1.0, settings.accuracy)
        test_maps = forward_maps if settings.quick else case.forward_maps(TEST_RANGE_FACTOR, settings.accuracy)
        clean_presses = simulate_presses(test_maps, case.test_sweep())
        noisy_charge = clean_presses.noisy(case.noise, case.seed + TEST_NOISE_SEED)

        charge_map = ChargeSpline.of(forward_maps[0])
        cramer_rao = limits_at(charge_map, clean_presses.contact, case.noise)
        limits = {
            "position_rms_mm": round_significant(rms(cramer_rao.position)),
            "position_median_mm": round_significant(float(np.median(cramer_rao.position))),
            "force_rms_percent": round_significant(100.0 * rms(cramer_rao.force)),
        }
        return replace(task, charge_map=charge_map), replace(clean_presses, charge=noisy_charge), limits
