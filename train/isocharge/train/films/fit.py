"""Training: the films of a sensor in, the weights of a network for all of them out."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from isocharge.common.arrays import Array
from isocharge.common.progress import Progress, StageProgress
from isocharge.simulate.execution.checkpointed_map import JobMap
from isocharge.simulate.forward.film_family import FilmFamily
from isocharge.simulate.measuring_chain.noise_file import noise_model
from isocharge.simulate.sensor.film_prior import FilmPrior
from isocharge.train.data.domain import ContactDomain
from isocharge.train.data.noise import misfit_noise
from isocharge.train.films.conditional_network import ConditionalPerceptron
from isocharge.train.films.config import FilmsConfig
from isocharge.train.films.contact_stage import ContactStage
from isocharge.train.films.film_presses import FilmPresses, draw_film_presses
from isocharge.train.films.film_scaling import FilmScaling
from isocharge.train.films.inputs import FilmInputs
from isocharge.train.films.misfit_films import MisfitStage, NearPresses, draw_misfit_films, draw_near_films
from isocharge.train.training.checkpoint import Checkpoint
from isocharge.train.training.descent import Descent, TrainingStage
from isocharge.train.training.fit import WARM_UP, threads_and_seed

BEYOND = 1.5e-3
"""How far the family reaches beyond the domain, m: a calibration moves presses whose place is not exactly known."""

FORCES_BEYOND = (0.8, 1.2)
"""The same for forces: factors of the smallest and the largest."""

LARGEST_GRADIENT = 5.0
"""Norm to which gradients are cut: films whose map nearly folds pull hard."""

FAMILY_STEPS, PRESSES_STEPS, MISFIT_STEPS, NEAR_STEPS = 15_000, 8_000, 12_000, 2_000
"""Steps of training that take about as long as solves, presses, examples of misfit, and good presses: for progress."""


@dataclass(frozen=True)
class FilmsFit:
    """Trained weights, and what they refer to.

    Attributes:
        inputs: What the networks see; prior and domain are in its scaling.
        family: Forward maps of the films.
        contact: Weights of the contact network, as `ConditionalWeights` takes them.
        misfit: Weights of the misfit network.
        config: What they were trained with.
    """

    inputs: FilmInputs
    family: FilmFamily
    contact: Mapping[str, Array]
    misfit: Mapping[str, Array]
    config: FilmsConfig


def fit_films(
    prior: FilmPrior,
    config: FilmsConfig,
    *,
    map_jobs: JobMap = map,
    checkpoint: Checkpoint | None = None,
    progress: StageProgress | None = None,
) -> FilmsFit:
    """Train on films drawn from a prior.

    Args:
        prior: The films.
        config: Sizes, steps, seed.
        map_jobs: Runs solves, presses and searches, in this process by default.
        checkpoint: Keeps the state, so that a stopped run goes on.
        progress: Called with steps done, all steps, and a text with the loss.

    Raises:
        ConfigError: If the noise level is unknown.
        SceneError, SolveError: If some presses cannot exist or be solved.
        DatasetError: If too many charges are not positive.
        TrainingError: If the loss is not finite.
    """
    noise_model(config.noise)  # an unknown level is said before the work
    with threads_and_seed(1, config.seed):
        return _FilmsTraining(prior, config, map_jobs, checkpoint or Checkpoint(), progress).run()


class _FilmsTraining:
    """One run: solves, presses, contact network, examples of misfit, misfit network."""

    def __init__(
        self,
        prior: FilmPrior,
        config: FilmsConfig,
        map_jobs: JobMap,
        checkpoint: Checkpoint,
        progress: StageProgress | None,
    ) -> None:
        self.prior, self.config, self.map_jobs = prior, config, map_jobs
        self.checkpoint, self.progress, self.done = checkpoint, progress, 0
        self.domain = ContactDomain(float(f"{1e3 * config.radius:.9g}"), config.force_range)
        self.total = FAMILY_STEPS + PRESSES_STEPS + config.steps + MISFIT_STEPS + NEAR_STEPS + config.misfit_steps

    def run(self) -> FilmsFit:
        family = FilmFamily.from_arrays(self._part("family", FAMILY_STEPS, "solving films", self._family))
        presses = self._part("presses", PRESSES_STEPS, "presses", lambda advance: self._presses(family, advance))
        inputs = FilmInputs.fit(FilmScaling(self.prior, self.domain), FilmPresses.from_arrays(presses))
        contact = self._contact(inputs, FilmPresses.from_arrays(presses))
        examples = self._part("examples", MISFIT_STEPS, "nearest contacts", lambda call: self._examples(family, call))
        near = self._part("near", NEAR_STEPS, "good presses", lambda call: self._near(family, call))
        misfit = self._misfit(inputs, examples, near)
        return FilmsFit(inputs, family, contact, misfit, self.config)

    def _part(self, name: str, steps: int, stage: str, work: Any) -> Any:
        """Arrays from the checkpoint, or computed; either way as a checkpoint gives them back."""
        arrays = self.checkpoint.load(name)
        if arrays is None:
            computed = work(self._share_of(steps, stage))
            arrays = {key: torch.tensor(v) if isinstance(v, np.ndarray) else v for key, v in computed.items()}
            self.checkpoint.save(name, lambda: arrays, now=True)
        self.done += steps
        return {key: value.numpy() if isinstance(value, torch.Tensor) else value for key, value in arrays.items()}

    def _share_of(self, steps: int, stage: str) -> Progress:
        """Progress of a part that counts as so many steps."""

        def advance(done: int, total: int) -> None:
            self._report(round(steps * done / total), f"{stage}: {done} of {total}")

        return advance

    def _report(self, done: int, text: str) -> None:
        if self.progress:
            self.progress(self.done + done, self.total, text)

    def _family(self, advance: Progress) -> dict[str, Any]:
        low, high = self.config.force_range
        forces = (low * FORCES_BEYOND[0], high * FORCES_BEYOND[1])
        radius = self.config.radius + BEYOND
        return FilmFamily.build(self.prior, radius, forces, map_jobs=self.map_jobs, progress=advance).to_arrays()

    def _presses(self, family: FilmFamily, advance: Progress) -> dict[str, np.ndarray]:
        config = self.config
        drawn = draw_film_presses(
            self.prior, family, self.domain, config.films, config.presses, config.seed,
            map_jobs=self.map_jobs, progress=advance,
        )  # fmt: skip
        return drawn.to_arrays()

    def _examples(self, family: FilmFamily, advance: Progress) -> dict[str, np.ndarray]:
        config = self.config
        return draw_misfit_films(
            self.prior, family, self.domain, misfit_noise(noise_model(config.noise)), config.misfit_films,
            config.misfit_charges, config.seed, map_jobs=self.map_jobs, progress=advance,
        )  # fmt: skip

    def _near(self, family: FilmFamily, advance: Progress) -> dict[str, np.ndarray]:
        config = self.config
        return draw_near_films(
            self.prior,
            family,
            self.domain,
            misfit_noise(noise_model(config.noise)),
            config.near_films,
            config.presses,
            config.seed,
            map_jobs=self.map_jobs,
            progress=advance,
        )

    def _network(self, inputs: FilmInputs, hidden: tuple[int, ...], outputs: int) -> ConditionalPerceptron:
        return ConditionalPerceptron(inputs.mean.size, hidden, outputs, inputs.scaling.standard[0].size)

    def _contact(self, inputs: FilmInputs, presses: FilmPresses) -> dict[str, Array]:
        config = self.config
        part = self._network(inputs, config.hidden, 6)
        warm_up = round(WARM_UP * config.steps)
        batch = (config.batch_films, config.batch_presses)
        noise = noise_model(config.noise)
        stage = ContactStage(part, inputs, presses, noise, config.watched, batch, warm_up, config.seed)
        task = TrainingStage("contact", part, stage.loss, stage.score, config.steps, warm_up, LARGEST_GRADIENT)
        self._descend(task)
        return part.to_arrays()

    def _misfit(
        self, inputs: FilmInputs, examples: dict[str, np.ndarray], near: dict[str, np.ndarray]
    ) -> dict[str, Array]:
        config = self.config
        part: ConditionalPerceptron = self._network(inputs, config.misfit_hidden, inputs.mean.size)
        good = NearPresses.of(inputs, near, misfit_noise(noise_model(config.noise)))
        stage = MisfitStage.of(part, good, examples, (config.batch_films, config.batch_presses))
        task = TrainingStage("misfit", part, stage.loss, stage.score, config.misfit_steps, 0, LARGEST_GRADIENT)
        self._descend(task)
        return part.to_arrays()

    def _descend(self, task: TrainingStage) -> None:
        """Train to the end: the schedule's last steps are the best."""
        Descent(task, self.config.learning_rate, task.steps, self.config.seed).run(self.checkpoint, self._report)
        self.done += task.steps
