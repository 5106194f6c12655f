"""Which row of a graph lies in which array of C: rows that are needed at the same time lie apart, others share.

A part of a row (`Split`) is an address inside it. An operation that turns each number into another works in place where
its row is not needed afterwards; all others read and write different arrays, so a compiler may assume that.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

from isocharge.serve.model.session import INPUT, OUTPUTS
from isocharge.train.export_c.differences import LOG_DIFFERENCES
from isocharge.train.export_c.graph import UNARY, Graph, Node

IN_PLACE = (*UNARY, "Clip", "Mul", LOG_DIFFERENCES)


@dataclass(frozen=True)
class Place:
    """Where a row lies: `array[offset]` and behind."""

    array: str
    offset: int = 0

    @property
    def address(self) -> str:
        """As C."""
        return f"{self.array} + {self.offset}" if self.offset else self.array


@dataclass
class Workspace:
    """Places of all rows, and sizes of the arrays.

    Attributes:
        places: By row.
        sizes: Numbers in each array, by its name.
    """

    places: dict[str, Place] = field(default_factory=lambda: {INPUT: Place(INPUT)})
    sizes: dict[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, graph: Graph) -> "Workspace":
        """Go through the nodes, give each result a free array, and free those that nothing needs any more."""
        space, last = cls(), _last_uses(graph)
        free: list[str] = []
        for number, node in enumerate(graph.nodes):
            if node.operator == "Split":
                space._divide(node, graph)
            else:
                space._place(node, graph, number, last, free)
            used = {space.places[row].array for row in (*node.inputs, *node.outputs)} & set(space.sizes)
            free += sorted(array for array in used if not space._needed(array, number, last) and array not in free)
        return space

    def _place(self, node: Node, graph: Graph, number: int, last: dict[str, int], free: list[str]) -> None:
        (result,), source = node.outputs, self.places[node.inputs[0]]
        width = graph.widths[result]
        in_place = node.operator in IN_PLACE and source.array != INPUT
        if in_place and not self._needed(source.array, number, last, but=node.inputs[0]):
            self.places[result] = source
            return
        array = _best(free, self.sizes, width) or f"row_{len(self.sizes)}"
        if array in free:
            free.remove(array)
        self.sizes[array] = max(width, self.sizes.get(array, 0))
        self.places[result] = Place(array)

    def _divide(self, node: Node, graph: Graph) -> None:
        whole = self.places[node.inputs[0]]
        offset = whole.offset
        for part in node.outputs:
            self.places[part] = Place(whole.array, offset)
            offset += graph.widths[part]

    def _needed(self, array: str, number: int, last: dict[str, int], but: str = "") -> bool:
        """Whether a row in this array is used after a node, or at it by another name than `but`."""
        return any(
            last.get(row, -1) > number or (but != "" and row != but and last.get(row, -1) >= number)
            for row, place in self.places.items()
            if place.array == array
        )


def _last_uses(graph: Graph) -> dict[str, int]:
    """Number of the last node that takes each row; beyond the last node for outputs."""
    last = {row: number for number, node in enumerate(graph.nodes) for row in node.inputs}
    return last | dict.fromkeys(OUTPUTS, len(graph.nodes))


def _best(free: Iterable[str], sizes: dict[str, int], width: int) -> str | None:
    """The smallest free array that is large enough, or else the largest."""
    fitting = sorted((sizes[array] < width, abs(sizes[array] - width), array) for array in free)
    return fitting[0][2] if fitting else None
