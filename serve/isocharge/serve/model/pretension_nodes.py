"""Pretensions (nodes) at which the files of a calibrated model contain values, and the interpolation between them."""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.common.errors import cut

MAX_NODES = 50
"""Largest number of nodes in a file."""

MAX_PRETENSION_MPa = 50.0
"""Largest pretension, MPa; PVDF yields at about 45 MPa."""

MIN_NODE_DISTANCE_MPa = 1e-3
"""Smallest distance of two nodes for which the interpolation is well conditioned, MPa."""


def interpolation_weights(node_MPa: Array, pretension_MPa: Array) -> Array:
    """Compute the weights with which values at nodes are interpolated to other pretensions.

    An interpolated value is the sum of the values at the k nodes, each multiplied by its weight. The weight of node i
    at the pretension p is a Lagrange polynomial, which is the product of (p - p_j) / (p_i - p_j) over all nodes j other
    than i.

    Args:
        node_MPa: Pretensions p_i of the nodes, shape (k,), MPa.
        pretension_MPa: Pretensions p, shape (n,), MPa.

    Returns:
        Weights, shape (n, k), dimensionless. Each row contains the weights for one pretension p, whose sum is 1.
    """
    is_other_node = ~np.eye(node_MPa.size, dtype=bool)  # shape (k, k), False where i equals j
    node_difference_MPa = node_MPa[:, None] - node_MPa  # p_i - p_j, shape (k, k)
    difference_MPa = pretension_MPa[:, None, None] - node_MPa  # p - p_j, shape (n, 1, k)

    # The factors with i equal to j do not belong to the product. Their denominator is 0, and is replaced by 1.
    denominator_MPa = np.where(is_other_node, node_difference_MPa, 1.0)
    factors = difference_MPa / denominator_MPa  # shape (n, k nodes i, k nodes j)
    return np.asarray(np.prod(factors, axis=2, where=is_other_node))


def neighbour_weights(node_MPa: Array, pretension_MPa: Array) -> Array:
    """Compute the weights with which values at nodes are interpolated linearly between the two nearest nodes.

    Args:
        node_MPa: Pretensions of the nodes in ascending order, shape (k,), MPa.
        pretension_MPa: Pretensions, shape (n,), MPa. Beyond the first or last node, the value at this node is used.

    Returns:
        Weights, shape (n, k), dimensionless. Each row has at most two weights that are not zero, and their sum is 1.
    """
    # The columns of the identity matrix are the values of functions that are 1 at one node and 0 at all other nodes.
    node_functions = np.eye(node_MPa.size)
    columns = [np.interp(pretension_MPa, node_MPa, node_function) for node_function in node_functions]
    return np.column_stack(columns)


def check_nodes(node_MPa: Array, required_MPa: float | None = None) -> None:
    """Check that the nodes of a file, which are pretensions in ascending order, are valid.

    Args:
        node_MPa: Pretensions of the nodes, shape (k,), MPa.
        required_MPa: Pretension that must be one of the nodes, MPa; None if no node is required.

    Raises:
        ValueError: If the pretensions are not in ascending order or too close to each other, if there are fewer than
            two or too many, if a pretension is too large, or if the required pretension is not one of them.
    """
    has_valid_count = 2 <= node_MPa.size <= MAX_NODES
    is_rising = bool((np.diff(node_MPa) >= MIN_NODE_DISTANCE_MPa).all())
    is_in_range = bool((np.abs(node_MPa) <= MAX_PRETENSION_MPa).all())
    has_required_node = required_MPa is None or required_MPa in node_MPa
    if has_valid_count and is_rising and is_in_range and has_required_node:
        return
    requirement = "" if required_MPa is None else f" with {required_MPa:g} MPa among them"
    raise ValueError(
        f"node_MPa: expected 2 to {MAX_NODES} rising pretensions up to {MAX_PRETENSION_MPa:g} MPa{requirement}, "
        f"got {cut(str(node_MPa))}"
    )
