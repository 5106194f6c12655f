"""The ONNX graph of a model, read and checked: rows of numbers, and the operators that our models are made of.

A graph works on one press, so each tensor is a row, and its width is all of its shape. What our exporter never writes
(another operator, domain or attribute) is refused with its name: a foreign graph must not become wrong C.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NoReturn

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from isocharge.common.errors import ModelError
from isocharge.common.tables import cut
from isocharge.serve.model.session import INPUT, OUTPUTS

UNARY = ("Log", "Exp", "Tanh", "Sinh")
"""Operators that turn each number of a row into another."""

LARGEST_INT8 = 127
"""The largest weight of a column in units of its scale, where weights are rounded to 8 bits."""

FIRST_OPSET, LAST_OPSET = 13, 17
"""Versions of the operators between which those below mean the same."""


@dataclass(frozen=True)
class Matrix:
    """Weights of a Gemm, shape (inputs, outputs).

    Attributes:
        values: float32, or int8 with scales.
        scale: Factor of each column of int8 values, shape (outputs,), float32; None for float32.
    """

    values: NDArray[Any]
    scale: NDArray[np.float32] | None = None

    @classmethod
    def of(cls, values: NDArray[np.float32]) -> "Matrix":
        """Weights as int8 if they are whole multiples of a scale of each column: rounded to 8 bits in training."""
        scale = np.abs(values).max(axis=0) / np.float32(LARGEST_INT8)
        whole = np.round(values / np.where(scale > 0.0, scale, 1.0))
        if np.allclose(whole * scale, values, rtol=2.0**-21, atol=0.0):  # as far as float32 can tell
            return cls(whole.astype(np.int8), scale.astype(np.float32))
        return cls(values)

    def as_floats(self) -> NDArray[np.float32]:
        """The weights themselves, shape (inputs, outputs)."""
        return self.values if self.scale is None else self.values * self.scale


@dataclass(frozen=True)
class Node:
    """One operation.

    Attributes:
        operator: Its ONNX name.
        inputs: Names of the rows that it takes; constants are in `constants`.
        outputs: Names of the rows that it gives.
        constants: Numbers of the operation, by a name that the operator decides.
    """

    operator: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    constants: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Graph:
    """A network on one press: the row `charge_pC`, nodes in their order, and the width of each row."""

    nodes: tuple[Node, ...]
    widths: Mapping[str, int]


def read_graph(onnx_model: bytes, where: str) -> Graph:
    """The graph of a model.

    Args:
        onnx_model: The file.
        where: Its name, for messages.

    Raises:
        ModelError: If it has an operator, attribute or shape that a model of ours has not.
    """
    try:
        model = onnx.load_model_from_string(onnx_model)
        onnx.checker.check_model(model)
    except Exception as error:  # protobuf's exceptions have no base in onnx
        raise ModelError(f"{where}: not a valid ONNX file ({cut(str(error))})") from error
    return _Reader(model, where).graph()


class _Reader:
    """Reads nodes in their order; knows the constants, and the widths of the rows so far."""

    def __init__(self, model: onnx.ModelProto, where: str) -> None:
        self._model, self._where = model, where
        self._constants: dict[str, NDArray[Any]] = {
            tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer
        }
        self._widths: dict[str, int] = {}
        self._node = onnx.NodeProto()

    def graph(self) -> Graph:
        self._check_versions()
        inputs = {tensor.name: _last_dimension(tensor) for tensor in self._model.graph.input}
        if list(inputs) != [INPUT]:
            self._refuse(f"expected the one input {INPUT}, got {list(inputs)}")
        self._widths.update(inputs)
        nodes = tuple(map(self._read, self._model.graph.node))
        got = {name: self._widths.get(name) for name in OUTPUTS}
        if got != OUTPUTS:
            self._refuse(f"expected outputs of the widths {OUTPUTS}, got {got}")
        return Graph(nodes, self._widths)

    def _check_versions(self) -> None:
        versions = {entry.domain: entry.version for entry in self._model.opset_import}
        if set(versions) != {""} or not FIRST_OPSET <= versions[""] <= LAST_OPSET:
            self._refuse(f"expected ONNX operators of version {FIRST_OPSET} to {LAST_OPSET} alone, got {versions}")

    def _read(self, proto: onnx.NodeProto) -> Node:
        self._node = proto
        readers: dict[str, Callable[[], Node]] = {
            **dict.fromkeys(UNARY, self._unary),
            "Clip": self._clip,
            "Mul": self._mul,
            "Gemm": self._gemm,
            "Split": self._split,
            "Concat": self._concat,
            "ReduceL2": self._length,
        }
        if proto.op_type not in readers:
            self._refuse(f"expected the operators {', '.join(readers)}, got {proto.op_type!r}")
        return readers[proto.op_type]()

    def _unary(self) -> Node:
        self._attributes({})
        return self._result((self._row(0),), self._width(0))

    def _clip(self) -> Node:
        self._attributes({})
        low, high = (float(self._constant(place, ()).item()) for place in (1, 2))
        return self._result((self._row(0),), self._width(0), low=low, high=high)

    def _mul(self) -> Node:
        self._attributes({})
        row, constant = (0, 1) if self._node.input[1] in self._constants else (1, 0)
        factor = self._constant(constant, (), (self._width(row),), (1,))
        values = np.broadcast_to(factor.astype(np.float32), self._width(row))
        return self._result((self._row(row),), self._width(row), factor=values)

    def _gemm(self) -> Node:
        attributes = self._attributes({"alpha": 1.0, "beta": 1.0, "transA": 0, "transB": (0, 1)})
        values = self._floats(self._node.input[1])
        values = values.T if attributes["transB"] else values
        if values.ndim != 2 or values.shape[0] != self._width(0):
            self._refuse(f"expected weights of {self._width(0)} rows, got the shape {values.shape}")
        matrix, outputs = Matrix.of(values), values.shape[1]
        if len(self._node.input) == 3 and self._node.input[2] in self._widths:
            if self._width(2) != outputs:
                self._refuse(f"expected a row of {outputs} to add, got one of {self._width(2)}")
            return self._result((self._row(0), self._row(2)), outputs, matrix=matrix)
        bias = self._constant(2, (), (1,), (outputs,)) if len(self._node.input) == 3 else np.zeros((), np.float32)
        values = np.broadcast_to(bias.astype(np.float32), outputs)
        return self._result((self._row(0),), outputs, matrix=matrix, bias=values)

    def _split(self) -> Node:
        attributes = self._attributes({"axis": (1, -1)}, required=True)
        name = self._node.input[1] if len(self._node.input) == 2 else ""
        sizes = [int(size) for size in self._constants.get(name, np.zeros(0)).ravel()]
        if sum(sizes) != self._width(0) or len(sizes) != len(self._node.output) or min(sizes, default=0) < 1:
            self._refuse(f"expected parts of a row of {self._width(0)}, got {sizes} (axis {attributes['axis']})")
        self._widths.update(zip(self._node.output, sizes, strict=True))
        return Node("Split", (self._row(0),), tuple(self._node.output))

    def _concat(self) -> Node:
        self._attributes({"axis": (1, -1)}, required=True)
        rows = tuple(self._row(place) for place in range(len(self._node.input)))
        return self._result(rows, sum(self._widths[row] for row in rows))

    def _length(self) -> Node:
        self._attributes({"axes": ([1], [-1]), "keepdims": 1}, required=True)
        return self._result((self._row(0),), 1)

    def _result(self, rows: tuple[str, ...], width: int, **constants: Any) -> Node:
        """The node with its one result."""
        (name,) = self._node.output
        self._widths[name] = width
        return Node(self._node.op_type, rows, (name,), constants)

    def _row(self, place: int) -> str:
        name = self._node.input[place] if place < len(self._node.input) else ""
        if name not in self._widths:
            self._refuse(f"expected a row computed before as input {place}, got {name!r}")
        return str(name)

    def _width(self, place: int) -> int:
        return self._widths[self._row(place)]

    def _constant(self, place: int, *shapes: tuple[int, ...]) -> NDArray[np.float32]:
        """A constant input of one of these shapes, or of a row of the last one."""
        name = self._node.input[place] if place < len(self._node.input) else ""
        values = self._floats(name)
        if values.ndim == 2 and len(values) == 1:
            values = values[0]
        if values.shape not in shapes:
            self._refuse(f"expected a constant of shape {' or '.join(map(str, shapes))}, got {values.shape}")
        return values

    def _floats(self, name: str) -> NDArray[np.float32]:
        values = self._constants.get(name)
        if values is None or values.dtype != np.float32 or not np.isfinite(values).all():
            self._refuse(f"expected finite float32 constants as input {name!r}")
        return values

    def _attributes(self, known: Mapping[str, Any], *, required: bool = False) -> dict[str, Any]:
        """The attributes, each as known: a value, or one of a tuple of values whose first is the default."""
        got = {entry.name: helper.get_attribute_value(entry) for entry in self._node.attribute}
        choices = {name: value if isinstance(value, tuple) else (value,) for name, value in known.items()}
        for name, value in got.items():
            if name not in choices or value not in choices[name]:
                self._refuse(f"expected the attributes {dict(known)}, got {name} = {value}")
        if required and not set(got) >= {"axis", "axes"} & set(known):
            self._refuse(f"expected the attributes {dict(known)}, got {got}")
        return {name: got.get(name, values[0]) for name, values in choices.items()}

    def _refuse(self, what: str) -> NoReturn:
        node = f"node {self._node.op_type} {list(self._node.output)}: " if self._node.op_type else ""
        raise ModelError(
            f"{self._where}: {node}{what}; this is not a graph of isocharge, which alone can be written as C"
        )


def _last_dimension(tensor: onnx.ValueInfoProto) -> int:
    return int(tensor.type.tensor_type.shape.dim[-1].dim_value) if tensor.type.tensor_type.shape.dim else 0
