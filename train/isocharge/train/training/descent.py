"""First-order training of one perceptron: optimisers, schedule, early stop, checkpoint.

Hidden layers are trained by Muon (Jordan et al. 2024), all other parameters by Adam with a short memory; at equal
steps the pair halves the error that plain Adam reaches on clean charges. The rate rises over a tenth of the steps and
falls to nothing along a cosine.
"""

import copy
import io
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from isocharge.common.errors import TrainingError
from isocharge.common.progress import report
from isocharge.common.resumable_run import ResumableRun
from isocharge.train.training.network import TrainableNetwork

MUON_RATE = 6.0
"""Ratio of Muon's rate to Adam's: a step of Muon has a given size whatever the gradient."""

RISE = 0.1
"""Length of the rate's rise over all steps, dimensionless."""

REPORT_EVERY = 200
"""Steps between two evaluations on presses that training does not see."""

SAVE_EVERY_S = 3.0
"""Seconds between two checkpoints."""


@dataclass(frozen=True)
class TrainingStage:
    """What to train and how well it does.

    Attributes:
        name: Of the stage, for checkpoints and messages.
        part: The network.
        loss: From (step, generator) to the loss of a fresh batch.
        score: The loss on presses that training does not see, and a text about it.
        steps: Number of steps.
        warm_up_steps: Steps before which no network counts as the best: they train another loss.
        largest_gradient: Norm to which gradients are cut after them.
    """

    name: str
    part: TrainableNetwork
    loss: Callable[[int, torch.Generator], Tensor]
    score: Callable[[], tuple[float, str]]
    steps: int
    warm_up_steps: int = 0
    largest_gradient: float = math.inf


class Descent:
    """One run of a stage; `run` goes on where a checkpoint says."""

    def __init__(self, stage: TrainingStage, rate: float, patience: int, seed: int) -> None:
        self.stage, self.patience = stage, patience
        self.optimisers = _optimisers(stage.part, rate)
        self.random = torch.Generator().manual_seed(seed)
        self.step, self.best, self.best_step = 0, math.inf, 0
        self.best_weights = copy.deepcopy(stage.part.state_dict())

    def run(self, run: ResumableRun | None = None) -> None:
        """Train; the part then holds the best weights that were seen.

        Args:
            run: Keeps the state every few seconds, so that a killed training goes on and ends with the same weights.

        Raises:
            TrainingError: If the loss is not finite.
        """
        saved_at = time.monotonic()
        if run and (state := run.load(self.stage.name, tensors)) is not None:
            self._restore(state)
        while self.step < self.stage.steps and not self._stalled():
            loss = self._advance()
            if self.step % REPORT_EVERY == 0 or self.step == self.stage.steps:
                self._evaluate(loss.item())
            if run and time.monotonic() - saved_at >= SAVE_EVERY_S:
                run.save(self.stage.name, tensor_bytes(self._state()))
                saved_at = time.monotonic()
        if run:
            run.save(self.stage.name, tensor_bytes(self._state()))
        self.stage.part.load_state_dict(self.best_weights)

    def _advance(self) -> Tensor:
        share = _rate_share(self.step / self.stage.steps)
        for optimiser, rate in self.optimisers:
            optimiser.param_groups[0]["lr"] = share * rate
        loss = self.stage.loss(self.step, self.random)
        self.stage.part.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        if self.step >= self.stage.warm_up_steps and math.isfinite(self.stage.largest_gradient):
            torch.nn.utils.clip_grad_norm_(self.stage.part.parameters(), self.stage.largest_gradient)
        for optimiser, _ in self.optimisers:
            optimiser.step()
        self.step += 1
        return loss

    def _evaluate(self, loss: float) -> None:
        with torch.no_grad():
            score, text = self.stage.score()
        if not (math.isfinite(loss) and math.isfinite(score)):
            raise TrainingError(
                f"the {self.stage.name} loss is {loss} at step {self.step} of {self.stage.steps}; lower "
                "training.learning_rate"
            )
        if self.step > self.stage.warm_up_steps and score < self.best:
            self.best, self.best_step = score, self.step
            self.best_weights = copy.deepcopy(self.stage.part.state_dict())
        report(f"training the {self.stage.name} network", self.step, self.stage.steps, f"loss {loss:.3f}, {text}")

    def _stalled(self) -> bool:
        return self.step - max(self.best_step, self.stage.warm_up_steps) >= self.patience

    def _state(self) -> dict[str, Any]:
        return {
            "part": self.stage.part.state_dict(),
            "optimisers": [optimiser.state_dict() for optimiser, _ in self.optimisers],
            "random": self.random.get_state(),
            "step": self.step,
            "best": (self.best, self.best_step),
            "best_weights": self.best_weights,
        }

    def _restore(self, state: dict[str, Any]) -> None:
        self.stage.part.load_state_dict(state["part"])
        for (optimiser, _), saved in zip(self.optimisers, state["optimisers"], strict=True):
            optimiser.load_state_dict(saved)
        self.random.set_state(state["random"])
        self.step, (self.best, self.best_step) = state["step"], state["best"]
        self.best_weights = state["best_weights"]


def tensor_bytes(state: object) -> bytes:
    """Tensors, numbers and texts as a part of a `ResumableRun`."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def tensors(data: bytes) -> Any:
    """The inverse of `tensor_bytes`; nothing in the bytes is executed."""
    return torch.load(io.BytesIO(data), weights_only=True)


def _rate_share(done: float) -> float:
    """Rate over its largest value when a share `done` of the steps is done."""
    if done < RISE:
        return 0.04 + 0.96 * 0.5 * (1.0 - math.cos(math.pi * done / RISE))
    return 0.5 * (1.0 + math.cos(math.pi * (done - RISE) / (1.0 - RISE)))


def _optimisers(part: TrainableNetwork, rate: float) -> list[tuple[torch.optim.Optimizer, float]]:
    """Optimisers of a network, each with its largest rate; rounded matrices have none."""
    hidden = {id(matrix) for matrix in part.hidden_matrices()}
    adam = torch.optim.Adam([each for each in part.parameters() if id(each) not in hidden], betas=(0.9, 0.98))
    trained = [matrix for matrix in part.hidden_matrices() if matrix.requires_grad]
    muon = [(torch.optim.Muon(trained, weight_decay=0.0), MUON_RATE * rate)] if trained else []
    return [*muon, (adam, rate)]
