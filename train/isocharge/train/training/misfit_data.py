"""Inputs and targets of the misfit network."""

from dataclasses import dataclass

import torch
from torch import Tensor

from isocharge.train.data.misfit_charges import MisfitExamples
from isocharge.train.training.config import TrainingConfig
from isocharge.train.training.network import InverseNetwork, compress_length

WATCHED = 0.5
"""Ratio of the positions that are watched while it trains to those that are held out."""


@dataclass(frozen=True)
class MisfitData:
    """The misfit network's data: inputs and compressed vectors, the last `watched` of them not trained on."""

    network: InverseNetwork
    inputs: Tensor
    targets: Tensor
    watched: int
    batch: int

    @classmethod
    def of(cls, network: InverseNetwork, examples: MisfitExamples, config: TrainingConfig) -> "MisfitData":
        inputs = network.inputs(torch.tensor(examples.charge_pC).float())
        watched = round(WATCHED * config.hold_out * len(inputs))
        return cls(network, inputs, compress_length(torch.tensor(examples.miss)).float(), watched, config.batch)

    def loss(self, _: int, random: torch.Generator) -> Tensor:
        rows = torch.randint(len(self.inputs) - self.watched, (self.batch,), generator=random)
        return self._squares(self.inputs[rows], self.targets[rows]).mean()

    def score(self) -> tuple[float, str]:
        with torch.no_grad():
            mean = self._squares(self.inputs[-self.watched :], self.targets[-self.watched :]).mean().item()
        return mean, f"{mean:.4f} on watched charges"

    def _squares(self, inputs: Tensor, targets: Tensor) -> Tensor:
        squares: Tensor = ((self.network.misfit_vector(inputs) - targets) ** 2).sum(dim=1)
        return squares
