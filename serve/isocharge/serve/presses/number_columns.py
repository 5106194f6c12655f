"""Named columns of numbers, and rules that state which numbers they may contain."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import LARGEST, Array, Booleans
from isocharge.common.errors import InputError, shown


@dataclass(frozen=True)
class ColumnRule:
    """Rule that states which numbers a column may contain.

    Attributes:
        description: Description of a correct cell for messages, such as "a force in N".
        maximum: Largest number that is accepted.
        is_positive: Whether only numbers above zero are accepted.
        may_be_empty: Whether empty cells are accepted.
    """

    description: str
    maximum: float = LARGEST
    is_positive: bool = False
    may_be_empty: bool = True

    def violations(self, values: Array) -> Booleans:
        """Compute which values of a column violate the rule.

        Args:
            values: Values of the column, shape (n,); NaN for an empty cell.

        Returns:
            Whether each value violates the rule, shape (n,).
        """
        # Comparisons with NaN are false, so these comparisons accept empty cells.
        is_violation = (values < -LARGEST) | (values > self.maximum)
        if self.is_positive:
            is_violation |= values <= 0.0
        if not self.may_be_empty:
            is_violation |= np.isnan(values)
        return is_violation


CHARGE_RULE = ColumnRule("a charge in pC")
"""Rule of the columns of charges."""


@dataclass(frozen=True)
class NumberColumns:
    """Columns of numbers, and the lines of a file from which their rows were read.

    Attributes:
        values: The columns by their names, each of shape (n,); NaN for an empty cell.
        lines: Line number of each row in the file.
    """

    values: Mapping[str, Array]
    lines: Sequence[int]

    def check(self, rules: Mapping[str, ColumnRule], where: str, error_class: type[InputError]) -> None:
        """Check that all values comply with the rules of their columns.

        Args:
            rules: Rules by the names of the columns.
            where: Beginning of the error message, such as "presses.csv, "; may be empty.
            error_class: Class of the error that is raised.

        Raises:
            error_class: If a value violates its rule. The message names the first wrong line, the column, the rule and
                the value.
        """
        violations_of_columns = [rules[name].violations(column) for name, column in self.values.items()]
        is_violation = np.column_stack(violations_of_columns)  # shape (n, n_column)
        positions = np.argwhere(is_violation)  # row and column of each violation, ordered by rows
        if not positions.size:
            return
        row, column_index = positions[0]  # the first violation
        name = list(self.values)[column_index]
        value = self.values[name][row]
        text = "an empty cell" if np.isnan(value) else f"{value:.15g}"
        raise error_class(
            f"{where}line {self.lines[row]}, column {shown(name)}: expected {rules[name].description}, got {text}"
        )
