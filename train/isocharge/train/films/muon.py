"""Optimisers of the network for all films: Muon for the weights between hidden layers, and Adam for all others."""

import torch

from isocharge.train.films.conditional_network import ConditionalPerceptron
from isocharge.train.training.descent import TrainingStage
from isocharge.train.training.network import TrainablePerceptron

MUON_RATE_FACTOR = 6.0
"""Learning rate of Muon, relative to that of Adam. The size of a step of Muon does not depend on the gradient."""

ADAM_BETAS = (0.9, 0.98)
"""Decay rates of Adam's moving averages of the gradient and of its square."""


def muon_and_adam(stage: TrainingStage) -> list[torch.optim.Optimizer]:
    """Return Muon (Jordan et al., 2024) for the constant weights between hidden layers, and Adam for all other weights.

    The learning rate of each optimiser is the rate of the stage times its `rate_factor`.

    Args:
        stage: The training of a `ConditionalPerceptron` or a `TrainablePerceptron`.
    """
    network = stage.network
    assert isinstance(network, ConditionalPerceptron | TrainablePerceptron)
    hidden_matrices = network.hidden_matrices()
    # Tensors are compared by identity, because == compares their elements.
    hidden_ids = {id(matrix) for matrix in hidden_matrices}
    other_parameters = [parameter for parameter in network.parameters() if id(parameter) not in hidden_ids]
    muon = torch.optim.Muon([{"params": hidden_matrices, "rate_factor": MUON_RATE_FACTOR}], weight_decay=0.0)
    adam = torch.optim.Adam([{"params": other_parameters, "rate_factor": 1.0}], betas=ADAM_BETAS)
    return [muon, adam]
