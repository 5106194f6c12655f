"""The optimiser SOAP, which applies Adam in the eigenbasis of the second moments of the gradient.

Let G be the gradient of a weight matrix. The optimiser averages the matrices G G^T and G^T G over the steps. In the
basis of the eigenvectors of these averages, the entries of the gradient are nearly uncorrelated. Adam scales each entry
separately. In this basis, Adam therefore comes close to a second-order method (Vyas et al., 2024, arXiv 2409.11321,
algorithm 3). The eigenvectors change slowly, and are updated every few steps by one orthogonal iteration.
"""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

BASIS_PERIOD = 10
"""Number of steps between two updates of the eigenvectors."""

EPSILON = 1e-10
"""Number that is added to each root mean square of the gradient, so that no division by zero occurs."""


MAX_RATIO = 2.0
"""Largest ratio of the averaged gradient to its root mean square, in the eigenbasis.

With equal decay rates, the ratio is at most 1, except where an update of the eigenvectors has moved a part of the
averaged gradient to an entry whose mean square is nearly zero. Such entries arise where the gradient of some weights
becomes different from zero only during the training. Without the limit, the step would be arbitrarily long.
"""


class Soap:
    """The optimiser SOAP. Parameters with one dimension, such as biases, are trained by Adam.

    The class has only those methods of PyTorch's optimisers that a training requires. The class is not derived from
    `torch.optim.Optimizer`, because creating the first object of that class imports PyTorch's compiler. The import
    takes a long time.

    Args:
        params: Parameters, or groups of parameters in the form that all optimisers of PyTorch accept. A parameter with
            more than two dimensions is an array of matrices.
        lr: Learning rate, which is approximately the change of each entry in one step.
        betas: Decay rates of the moving averages of the gradient and of its second moments.

    Attributes:
        param_groups: Parameters and settings of each group, which may be changed between two steps.
    """

    def __init__(
        self,
        params: Iterable[Tensor] | Iterable[dict[str, Any]],
        lr: float = 1e-3,
        betas: tuple[float, float] = (0.95, 0.95),
    ) -> None:
        """Prepare the optimiser. The class describes the arguments.

        Parameters that do not belong to a group form one group with the settings `lr` and `betas`.
        """
        defaults: dict[str, Any] = {"lr": lr, "betas": betas}
        self.param_groups: list[dict[str, Any]] = []
        single_parameters: list[Tensor] = []
        for parameter_or_group in params:
            if isinstance(parameter_or_group, Tensor):
                single_parameters.append(parameter_or_group)
            else:
                self.param_groups.append(defaults | parameter_or_group)
        if single_parameters:
            self.param_groups.append(defaults | {"params": single_parameters})
        # One state for each parameter, in the order of the groups. A state is empty until the first step.
        self._states: list[dict[str, Any]] = [{} for group in self.param_groups for _ in group["params"]]

    @torch.no_grad()
    def step(self) -> None:
        """Update all parameters that have a gradient, each with its own state."""
        states = iter(self._states)
        for group in self.param_groups:
            for parameter in group["params"]:
                state = next(states)
                if parameter.grad is not None:
                    _update(parameter, parameter.grad, state, group["lr"], group["betas"])


def _update(
    parameter: Tensor, gradient: Tensor, state: dict[str, Any], rate: float, betas: tuple[float, float]
) -> None:
    """Change one parameter and its state by one step of SOAP (Vyas et al., 2024, algorithm 3).

    The averaged gradient is rotated into the eigenbasis. As in Adam, each entry of the rotated gradient is divided by
    the root mean square of this entry over the past steps. The result is rotated back and gives the direction of the
    step.

    Args:
        parameter: Parameter to change.
        gradient: Gradient of the parameter, of the same shape.
        state: Moving averages and eigenvectors of the parameter; empty before the first step.
        rate: Learning rate.
        betas: Decay rates of the moving averages of the gradient and of its second moments.
    """
    if not state:
        state.update(_initial_state(gradient))
    state["step"] += 1
    mean_decay, square_decay = betas

    # Update the moving averages of G G^T and G^T G, where G is the gradient, and the eigenbases of these averages.
    if gradient.ndim > 1:  # vectors have no eigenbases
        state["row_moment"].lerp_(gradient @ gradient.mT, 1.0 - square_decay)
        state["column_moment"].lerp_(gradient.mT @ gradient, 1.0 - square_decay)
        if state["step"] % BASIS_PERIOD == 1:  # at the first step, and then once in a period
            _update_basis(state)

    # Update the moving averages of the gradient, and of its squared entries in the eigenbasis.
    mean = state["mean"].lerp_(gradient, 1.0 - mean_decay)
    rotated_gradient = _rotate(gradient, state)
    mean_square = state["square"].mul_(square_decay)
    mean_square.addcmul_(rotated_gradient, rotated_gradient, value=1.0 - square_decay)

    # The moving averages begin at zero. They are therefore divided by the total weight of all gradients so far.
    mean_weight = 1.0 - mean_decay ** state["step"]
    square_weight = 1.0 - square_decay ** state["step"]
    root_mean_square = (mean_square / square_weight).sqrt_().add_(EPSILON)
    ratio = _rotate(mean, state) / (mean_weight * root_mean_square)
    direction = _rotate_back(ratio.clamp_(-MAX_RATIO, MAX_RATIO), state)
    parameter.add_(direction, alpha=-rate)


def _initial_state(gradient: Tensor) -> dict[str, Any]:
    """Return the state of a parameter before its first step.

    The averages are zero, and the eigenbases are identity matrices.

    Args:
        gradient: Gradient of the parameter, which is an array of matrices, shape (..., n_row, n_column), or a vector. A
            vector has no eigenbases.
    """
    state: dict[str, Any] = {
        "step": 0,
        "mean": torch.zeros_like(gradient),
        "square": torch.zeros_like(gradient),
    }
    if gradient.ndim > 1:
        *batch, n_row, n_column = gradient.shape
        for name, size in (("row", n_row), ("column", n_column)):
            identity = torch.eye(size, dtype=gradient.dtype)
            state[f"{name}_moment"] = gradient.new_zeros(*batch, size, size)
            state[f"{name}_basis"] = identity.expand(*batch, size, size).clone()
    return state


def _update_basis(state: dict[str, Any]) -> None:
    """Bring both eigenbases closer to the eigenvectors by one orthogonal iteration."""
    for name in ("row", "column"):
        basis = state[f"{name}_basis"]
        state[f"{name}_basis"] = torch.linalg.qr(state[f"{name}_moment"] @ basis).Q


def _rotate(matrix: Tensor, state: dict[str, Any]) -> Tensor:
    """Transform a matrix to the eigenbasis. A vector is returned unchanged."""
    if matrix.ndim < 2:
        return matrix
    rotated: Tensor = state["row_basis"].mT @ matrix @ state["column_basis"]
    return rotated


def _rotate_back(matrix: Tensor, state: dict[str, Any]) -> Tensor:
    """Transform a matrix from the eigenbasis back to the original basis. A vector is returned unchanged."""
    if matrix.ndim < 2:
        return matrix
    rotated: Tensor = state["row_basis"] @ matrix @ state["column_basis"].mT
    return rotated
