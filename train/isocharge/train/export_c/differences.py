"""Logarithms of the charges as one of them and the others' distances from it: the same function, with less rounding.

The charges of a film rise and fall together, and position is in what tells them apart. So a first layer has large
weights of both signs on logarithms that are nearly equal, and its sums nearly cancel:

    sum_k w_k ln q_k = (sum_k w_k) ln q_0 + sum_k w_k ln(q_k / q_0).

On the right the subtraction comes first. The difference of two charges within a factor of two is exact (Sterbenz 1974),
and the logarithm of 1 + (q_k - q_0) / q_0 has all its digits, where that of a charge has lost some to its size.
"""

from dataclasses import replace

import numpy as np

from isocharge.train.export_c.graph import Graph, Matrix, Node

LOG_DIFFERENCES = "LogDifferences"
"""Operator from a row (q_0, q_1, ...) to (ln q_0, ln(q_1 / q_0), ...)."""


def with_differences(graph: Graph) -> Graph:
    """The graph with differences for each row of logarithms that only layers take."""
    nodes = list(graph.nodes)
    for log in [node for node in graph.nodes if node.operator == "Log"]:
        (row,) = log.outputs
        readers = [node for node in nodes if row in node.inputs]
        if all(node.operator == "Gemm" and node.inputs[0] == row for node in readers):
            nodes = [_of_differences(node) if node in readers else node for node in nodes]
            nodes[nodes.index(log)] = replace(log, operator=LOG_DIFFERENCES)
    return Graph(tuple(nodes), graph.widths)


def _of_differences(gemm: Node) -> Node:
    """A layer that takes differences instead of the logarithms themselves."""
    values = gemm.constants["matrix"].as_floats().astype(np.float64)
    values[0] = values.sum(axis=0)
    return replace(gemm, constants={**gemm.constants, "matrix": Matrix(values.astype(np.float32))})
