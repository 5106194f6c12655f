"""Levenberg-Marquardt: the finish of a small network on clean charges, where first-order steps crawl.

The normal equations of all samples are gathered chunk by chunk, so memory holds one chunk's Jacobian and a matrix of
(parameters)^2. Damping follows Marquardt (1963): a step that lowers the sum of squares brings it nearer to
Gauss-Newton, one that does not brings it nearer to the gradient.
"""

from collections.abc import Callable, Iterator, Mapping

import torch
from torch import Tensor
from torch.func import functional_call, jacrev, vmap
from torch.nn import Module

CHUNK = 1024
"""Samples whose Jacobian is held at once."""

EASIER, HARDER = 1.0 / 3.0, 4.0
"""Factors of the damping after a step that helped and one that did not."""

FIRST, LEAST, MOST = 1e-3, 1e-12, 1e8
"""Damping at the start, and its bounds, relative to the diagonal of the normal equations."""

Parameters = dict[str, Tensor]


def levenberg_marquardt(
    part: Module, inputs: Tensor, targets: Tensor, steps: int, damping: float = FIRST
) -> Iterator[tuple[float, float]]:
    """Minimise sum (part(inputs)[:, :k] - targets)^2 over the parameters of `part`, in place, step by step.

    Args:
        part: A network; every parameter is moved.
        inputs: Shape (n, ...).
        targets: Shape (n, k); further outputs of the network are left out.
        steps: Most steps; it ends earlier where no step helps any more.
        damping: What the last call yielded, to go on from there.

    Yields:
        The sum of squares after each step that helped, and the damping for the next.
    """
    values = {name: parameter.detach() for name, parameter in part.named_parameters()}
    residual = _residual(part, targets.shape[1])
    square = _square(residual, values, inputs, targets)
    for _ in range(steps):
        normal, slope = _normal_equations(residual, values, inputs, targets)
        while damping <= MOST:
            tried = _moved(values, _step(normal, slope, damping))
            tried_square = _square(residual, tried, inputs, targets)
            if tried_square < square:
                break
            damping *= HARDER
        else:
            return
        values, square, damping = tried, tried_square, max(damping * EASIER, LEAST)
        part.load_state_dict(values)
        yield square, damping


def _residual(part: Module, columns: int) -> Callable[[Parameters, Tensor, Tensor], Tensor]:
    def residual(values: Parameters, inputs: Tensor, targets: Tensor) -> Tensor:
        out: Tensor = functional_call(part, values, (inputs,))
        return out[..., :columns] - targets

    return residual


def _square(
    residual: Callable[[Parameters, Tensor, Tensor], Tensor], values: Parameters, inputs: Tensor, targets: Tensor
) -> float:
    with torch.no_grad():
        return float((residual(values, inputs, targets) ** 2).sum())


def _normal_equations(
    residual: Callable[[Parameters, Tensor, Tensor], Tensor], values: Parameters, inputs: Tensor, targets: Tensor
) -> tuple[Tensor, Tensor]:
    """J' J and J' r over all samples."""
    of_sample = vmap(jacrev(residual), in_dims=(None, 0, 0))
    count = sum(value.numel() for value in values.values())
    normal, slope = torch.zeros(count, count, dtype=inputs.dtype), torch.zeros(count, dtype=inputs.dtype)
    with torch.no_grad():
        for some, target in zip(torch.split(inputs, CHUNK), torch.split(targets, CHUNK), strict=True):
            rows: Mapping[str, Tensor] = of_sample(values, some, target)
            jacobian = torch.cat([rows[name].flatten(2) for name in values], dim=2).flatten(0, 1)
            normal.addmm_(jacobian.T, jacobian)
            slope.addmv_(jacobian.T, residual(values, some, target).flatten())
    return normal, slope


def _step(normal: Tensor, slope: Tensor, damping: float) -> Tensor:
    """-(J' J + damping diag(J' J))^-1 J' r, with a floor under the diagonal: a parameter may have no effect at all."""
    diagonal = normal.diagonal()
    damped = normal + torch.diag(damping * diagonal.clamp(min=1e-9 * float(diagonal.max())))
    factor, failed = torch.linalg.cholesky_ex(damped)
    if failed:  # rounding: not positive definite at this damping
        return torch.zeros_like(slope)
    return -torch.cholesky_solve(slope[:, None], factor)[:, 0]


def _moved(values: Parameters, step: Tensor) -> Parameters:
    sizes = [value.numel() for value in values.values()]
    parts = zip(values.items(), torch.split(step, sizes), strict=True)
    return {name: value + part.view_as(value) for (name, value), part in parts}
