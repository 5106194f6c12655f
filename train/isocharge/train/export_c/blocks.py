"""Blocks of a matrix outside which it is zero: perceptrons that run side by side need no products between them."""

from dataclasses import dataclass

from isocharge.train.export_c.graph import Matrix

LEAST_ROWS = 8
"""Rows of a block below which a loop of its own costs more than products with zero."""


@dataclass(frozen=True)
class Block:
    """Rows and columns of a matrix, each from a first to before a last."""

    rows: tuple[int, int]
    columns: tuple[int, int]

    def joined(self, other: "Block") -> "Block":
        """The smallest block that holds both."""
        return Block(_span(self.rows, other.rows), _span(self.columns, other.columns))


def diagonal_blocks(matrix: Matrix) -> list[Block]:
    """The blocks along the diagonal that hold all that is not zero, top to bottom; one block if they are small."""
    filled = matrix.values != 0
    blocks: list[Block] = []
    for row, columns in enumerate(line.nonzero()[0] for line in filled):
        if not columns.size:
            continue
        block = Block((row, row + 1), (int(columns[0]), int(columns[-1]) + 1))
        while blocks and block.columns[0] < blocks[-1].columns[1]:
            block = blocks.pop().joined(block)
        blocks.append(block)
    if len(blocks) < 2 or min(block.rows[1] - block.rows[0] for block in blocks) < LEAST_ROWS:
        return [Block((0, filled.shape[0]), (0, filled.shape[1]))]
    return blocks


def _span(one: tuple[int, int], other: tuple[int, int]) -> tuple[int, int]:
    return min(one[0], other[0]), max(one[1], other[1])
