"""Each operation of a graph as C statements on the arrays of its workspace."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from isocharge.serve.model.session import OUTPUTS
from isocharge.train.export_c.c_text import c_array, c_float
from isocharge.train.export_c.differences import LOG_DIFFERENCES
from isocharge.train.export_c.gemm import GemmSource
from isocharge.train.export_c.graph import Graph, Node
from isocharge.train.export_c.workspace import Place, Workspace

FUNCTIONS = {"Log": "logf", "Exp": "expf", "Sinh": "sinhf", "Tanh": "tanh_of"}
"""ONNX operator to the function of C."""


@dataclass
class NetworkSource:
    """The network as C.

    Attributes:
        definitions: Constant arrays and functions, in their order.
        statements: The body of `isocharge_predict`, without declarations.
        arrays: Numbers in each array of the body, by its name.
    """

    definitions: list[str] = field(default_factory=list)
    statements: list[str] = field(default_factory=list)
    arrays: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, graph: Graph) -> "NetworkSource":
        """Write a graph."""
        space = Workspace.of(graph)
        source = cls(arrays=dict(space.sizes))
        writers: dict[str, Callable[[_Operation], None]] = {
            **dict.fromkeys(FUNCTIONS, source._function),
            "Clip": source._clip,
            "Mul": source._mul,
            "Gemm": source._gemm,
            "Split": lambda _: None,
            "Concat": source._concat,
            "ReduceL2": source._length,
            LOG_DIFFERENCES: source._log_differences,
        }
        for node in graph.nodes:
            writers[node.operator](_Operation(node, graph, space))
        source._outputs(graph, space)
        return source

    def _function(self, operation: "_Operation") -> None:
        self._each(operation, f"{FUNCTIONS[operation.node.operator]}({operation.element})")

    def _clip(self, operation: "_Operation") -> None:
        low, high = (c_float(operation.node.constants[name]) for name in ("low", "high"))
        self._each(operation, f"clip({operation.element}, {low}, {high})")

    def _mul(self, operation: "_Operation") -> None:
        factor = operation.node.constants["factor"]
        if np.all(factor == factor[0]):
            self._each(operation, f"{operation.element} * {c_float(factor[0])}")
            return
        name = f"factor_{len(self.definitions)}"
        self.definitions.append(c_array("float", name, factor))
        self._each(operation, f"{operation.element} * {name}[i]")

    def _gemm(self, operation: "_Operation") -> None:
        constants = operation.node.constants
        name = f"layer_{len(self.definitions)}"
        self.definitions.append(GemmSource(name, constants["matrix"], constants.get("bias")).text())
        rows = [operation.space.places[row].address for row in (*operation.node.inputs, operation.result)]
        self.statements.append(f"{name}({', '.join(rows)});")

    def _concat(self, operation: "_Operation") -> None:
        target = operation.space.places[operation.result]
        offset = target.offset
        for row in operation.node.inputs:
            width = operation.graph.widths[row]
            self._copy(width, Place(target.array, offset), operation.space.places[row])
            offset += width

    def _length(self, operation: "_Operation") -> None:
        width = operation.graph.widths[operation.node.inputs[0]]
        target = _element(operation.space.places[operation.result], "0")
        self.statements += [
            f"{target} = 0.0f;",
            f"for (int i = 0; i < {width}; ++i)\n    {target} += {operation.element} * {operation.element};",
            f"{target} = sqrtf({target});",
        ]

    def _log_differences(self, operation: "_Operation") -> None:
        """The first number last: the others need it, and the row may be in place."""
        row, result = (operation.space.places[name] for name in (operation.node.inputs[0], operation.result))
        first = _element(row, "0")
        self.statements += [
            f"for (int i = 1; i < {operation.graph.widths[operation.result]}; ++i)\n"
            f"    {_element(result)} = log_ratio({_element(row)}, {first});",
            f"{_element(result, '0')} = logf({first});",
        ]

    def _outputs(self, graph: Graph, space: Workspace) -> None:
        offset = 0
        for name in OUTPUTS:
            self._copy(graph.widths[name], Place("contact", offset), space.places[name])
            offset += graph.widths[name]

    def _each(self, operation: "_Operation", expression: str) -> None:
        """A loop over the numbers of a row."""
        target = _element(operation.space.places[operation.result])
        width = operation.graph.widths[operation.result]
        self.statements.append(f"for (int i = 0; i < {width}; ++i)\n    {target} = {expression};")

    def _copy(self, width: int, target: Place, row: Place) -> None:
        self.statements.append(f"for (int i = 0; i < {width}; ++i)\n    {_element(target)} = {_element(row)};")


@dataclass(frozen=True)
class _Operation:
    """A node with what is needed to write it."""

    node: Node
    graph: Graph
    space: Workspace

    @property
    def result(self) -> str:
        return self.node.outputs[0]

    @property
    def element(self) -> str:
        """Number i of the row that it takes."""
        return _element(self.space.places[self.node.inputs[0]])


def _element(place: Place, index: str = "i") -> str:
    return f"{place.array}[{f'{place.offset} + ' if place.offset else ''}{index}]"
