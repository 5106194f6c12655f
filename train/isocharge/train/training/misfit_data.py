"""Inputs and targets of the misfit network."""

from dataclasses import dataclass

import torch
from torch import Tensor

from isocharge.train.data.misfit_charges import MisfitExamples
from isocharge.train.training.config import TrainingConfig
from isocharge.train.training.network import InverseNetwork, compress_length

WATCHED = 0.5
"""Positions that are watched while it trains, over those that are held out."""


@dataclass(frozen=True)
class _Learned:
    """The misfit network's data: inputs and squeezed vectors, the last `watched` of them kept aside."""

    network: InverseNetwork
    inputs: Tensor
    wanted: Tensor
    watched: int
    batch: int

    @classmethod
    def of(cls, network: InverseNetwork, strange: MisfitExamples, config: TrainingConfig) -> "_Learned":
        inputs = network.inputs(torch.tensor(strange.charge_pC).float())
        watched = round(WATCHED * config.hold_out * len(inputs))
        return cls(network, inputs, compress_length(torch.tensor(strange.miss)).float(), watched, config.batch)

    def loss(self, _: int, random: torch.Generator) -> Tensor:
        rows = torch.randint(len(self.inputs) - self.watched, (self.batch,), generator=random)
        squares: Tensor = ((self.network.missing(self.inputs[rows]) - self.wanted[rows]) ** 2).sum(dim=1)
        return squares.mean()

    def score(self) -> tuple[float, str]:
        with torch.no_grad():
            off = ((self.network.missing(self.inputs[-self.watched :]) - self.wanted[-self.watched :]) ** 2).sum(dim=1)
        return off.mean().item(), f"{off.mean().item():.4f} on watched charges"
