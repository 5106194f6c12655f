"""The network of a model file, read along the one graph that `release.export` writes.

A file with another node, wiring or attribute is refused with the name of the node: a foreign graph must not become
wrong C.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NoReturn

import numpy as np
import onnx
from numpy.typing import NDArray

from isocharge.common.arrays import Singles
from isocharge.common.errors import ModelError, cut
from isocharge.serve.model.session import CORRELATION, INPUT, OUTPUTS

OPSET = 17
"""Version of the ONNX operators."""

PLANE, LOGS = 2, 4
"""Answers of the last layer: x and y; logarithms of force and standard deviations; then come the arguments of cosines,
of which a graph without correlations has none, and the misfit vector."""

CONSTANT = ""
"""Stands for a constant among the inputs of a node."""


@dataclass(frozen=True)
class Network:
    """What a model computes from the logarithms of its charges; arrays are float32.

    Attributes:
        low, high: Bounds of the charges, shape (electrodes,), pC; of shape () if they are the same for all.
        factor: Unit of each charge, shape (electrodes,), 1/pC.
        mean: What is subtracted from asinh(Q factor), shape (electrodes,), where that stands for the logarithm; else
            None.
        hidden: Weights (inputs, outputs) and bias of the layers that tanh follows.
        last: Weights from the last of them to the answers.
        skip: Weights and bias from the logarithms to the answers.
        cosines: Weights from the cosines to the correlations, shape (cosines, 3).
        misfit_unit: Factor on the hyperbolic sine of the misfit vector's length.
    """

    low: Singles
    high: Singles
    factor: Singles
    mean: Singles | None
    hidden: tuple[tuple[Singles, Singles], ...]
    last: Singles
    skip: tuple[Singles, Singles]
    cosines: Singles
    misfit_unit: float

    @property
    def known(self) -> int:
        """Answers before the misfit vector."""
        return PLANE + LOGS + len(self.cosines)


def read_network(onnx_model: bytes, where: str) -> Network:
    """The network of a model file.

    Args:
        onnx_model: The file.
        where: Its name, for messages.

    Raises:
        ModelError: If it is not a graph of `release.export`.
    """
    try:
        model = onnx.load_model_from_string(onnx_model)
        onnx.checker.check_model(model, full_check=True)
    except Exception as error:  # protobuf's exceptions have no base in onnx
        raise ModelError(f"{where}: not a valid ONNX file ({cut(str(error))})") from error
    nodes = _Nodes(model.graph, where)
    if (versions := {entry.domain: entry.version for entry in model.opset_import}) != {"": OPSET}:
        nodes.refuse(f"expected ONNX operators of version {OPSET} alone, got {versions}")
    mean: Singles | None = None
    if nodes.coming(1) == ["Max"]:
        [above], [low] = nodes.take("Max", INPUT, CONSTANT)
        [within], [high] = nodes.take("Min", above, CONSTANT)
        [scaled], [factor] = nodes.take("Mul", within, CONSTANT)
        [bent], _ = nodes.take("Asinh", scaled)
        [logs], [mean] = nodes.take("Sub", bent, CONSTANT)
    else:
        [within], [low, high] = nodes.take("Clip", INPUT, CONSTANT, CONSTANT)
        [scaled], [factor] = nodes.take("Mul", within, CONSTANT)
        [logs], _ = nodes.take("Log", scaled)
    value = logs
    hidden: list[tuple[Singles, Singles]] = []
    while not hidden or nodes.coming(2) == ["Gemm", "Tanh"]:
        [row], [weights, bias] = nodes.take("Gemm", value, CONSTANT, CONSTANT)
        [value], _ = nodes.take("Tanh", row)
        hidden.append((weights, bias))
    [skipped], skip = nodes.take("Gemm", logs, CONSTANT, CONSTANT)
    [answers], [last] = nodes.take("Gemm", value, CONSTANT, skipped)
    results = nodes.results()
    [plane, logarithms, *angles, vector], parts = nodes.take("Split", answers, CONSTANT, results=results, axis=1)
    [exponentials], _ = nodes.take("Exp", logarithms)
    [force, contact_std], powers = nodes.take("Split", exponentials, CONSTANT, results=2, axis=1)
    [contact], _ = nodes.take("Concat", plane, force, axis=1)
    correlation: list[str] = []
    cosines: Singles = np.empty((0, 3), np.float32)
    for arguments in angles:
        [cosine], _ = nodes.take("Cos", arguments)
        correlation, [cosines] = nodes.take("MatMul", cosine, CONSTANT)
    [length], _ = nodes.take("ReduceL2", vector, axes=[1], keepdims=1)
    [sinh], _ = nodes.take("Sinh", length)
    [misfit], [unit] = nodes.take("Mul", sinh, CONSTANT)
    n = factor.size
    outputs = [name for name in OUTPUTS if correlation or name != CORRELATION]
    sizes = [PLANE, LOGS, *([len(cosines)] if correlation else []), n]
    found = [contact, contact_std, *correlation, misfit, *parts[0].tolist(), *powers[0].tolist(), nodes.coming(1)]
    if found != [*outputs, *sizes, 1, LOGS - 1, []]:
        answers_in = " + ".join(map(str, sizes))
        nodes.refuse(f"expected the outputs {', '.join(outputs)} from {answers_in} answers, got {found}")
    network = Network(low, high, factor, mean, tuple(hidden), last, (skip[0], skip[1]), cosines, unit.item())
    nodes.check_shapes(network)
    return network


class _Nodes:
    """Takes the nodes of a graph one after the other."""

    def __init__(self, graph: onnx.GraphProto, where: str) -> None:
        self._left, self._where = list(graph.node), where
        self._constants = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.initializer}

    def coming(self, count: int) -> list[str]:
        """Operators of the next nodes."""
        return [node.op_type for node in self._left[:count]]

    def results(self) -> int:
        """Number of results of the next node: three, or four where there are correlations."""
        return 4 if self._left and len(self._left[0].output) == 4 else 3

    def take(
        self, operator: str, *inputs: str, results: int = 1, **attributes: Any
    ) -> tuple[list[str], list[NDArray[Any]]]:
        """Names of the results and constants of the next node, which is the one described."""
        node = self._left.pop(0) if self._left else onnx.NodeProto()
        names = [CONSTANT if name in self._constants else name for name in node.input]
        given = {entry.name: onnx.helper.get_attribute_value(entry) for entry in node.attribute}
        expected = (operator, list(inputs), results, attributes)
        got = (node.op_type, names, len(node.output), given)
        if got != expected:
            self.refuse(f"node {node.op_type} {list(node.output)}: expected {expected}, got {got}")
        constants = [self._constants[name] for name in node.input if name in self._constants]
        if not all(np.isfinite(values).all() for values in constants):
            self.refuse(f"node {operator} {list(node.output)}: expected finite constants")
        return list(node.output), constants

    def check_shapes(self, network: Network) -> None:
        """The constants must fit each other."""
        n = network.factor.size
        widths = [n, *(bias.size for _, bias in network.hidden), network.known + n]
        layers = [*network.hidden, (network.last, network.skip[1]), network.skip]
        expected = [*pairwise(widths), (n, widths[-1]), (len(network.cosines), 3)]
        got = [*(weights.shape for weights, _ in layers), network.cosines.shape]
        bounds = [] if network.mean is None else [network.low, network.high, network.mean]
        if any(values.shape != (n,) for values in bounds):
            self.refuse(f"expected {n} bounds and means, one for each charge, got {[each.shape for each in bounds]}")
        if got != expected or any(bias.shape != shape[1:] for (_, bias), shape in zip(layers, expected, strict=False)):
            self.refuse(f"expected weights of the shapes {expected} and a bias for each column, got {got}")

    def refuse(self, what: str) -> NoReturn:
        """Say what is foreign."""
        raise ModelError(f"{self._where}: {what}; this is not a graph of isocharge, which alone can be written as C")
