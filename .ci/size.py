"""Print the size of the source: modules, nodes of the syntax tree and numeric constants of each package.

    python .ci/size.py

Nodes are counted without docstrings and without the context nodes of Python (Load, Store, Del), so that line breaks and
comments do not change the size. A constant is a number that is assigned at the level of a module. A test compares the
totals with the limits in the section `tool.isocharge.size` of pyproject.toml.
"""

import ast
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PORTIONS = ("simulate", "train", "serve")
COLUMNS = ("modules", "nodes", "constants")


def measure_module(path: Path) -> Counter[str]:
    """Count the nodes and the numeric constants of one module.

    Docstrings and the context nodes (Load, Store, Del) are not counted. A numeric constant is a number that is assigned
    at the level of the module.

    Returns:
        The counts under the keys `COLUMNS`: "modules", which is 1, "nodes" and "constants".
    """
    tree = ast.parse(path.read_text())
    counts = Counter(modules=1)
    for node in ast.walk(tree):
        if _is_docstring(node):
            # A docstring is a statement node and a text node. The loop also reaches the text node and adds 1 for it.
            # The two steps cancel, so that a docstring counts nothing.
            counts["nodes"] -= 1
        elif not isinstance(node, ast.Load | ast.Store | ast.Del):
            counts["nodes"] += 1
    for statement in tree.body:
        if isinstance(statement, ast.Assign | ast.AnnAssign):
            counts["constants"] += _is_number(statement.value)  # adds 1 for True
    return counts


def measure_packages(root: Path = ROOT) -> dict[str, Counter[str]]:
    """Return the numbers of modules, nodes and constants of each package, as `measure_module` counts them.

    Deeper folders count as parts of their package.

    Args:
        root: Folder of the repository.

    Returns:
        Counts by the name of the package, such as "simulate/simulate/forward": a portion and at most two folders.
    """
    packages: dict[str, Counter[str]] = {}
    for portion in PORTIONS:  # the folders of the repository that contain a part of the source each
        source = root / portion / "isocharge"
        for path in sorted(source.rglob("*.py")):
            folders = path.relative_to(source).parts[:-1]
            name = "/".join((portion, *folders[:2]))
            packages.setdefault(name, Counter()).update(measure_module(path))
    return packages


def total_size(packages: dict[str, Counter[str]]) -> Counter[str]:
    """Return the sum of the sizes of all packages."""
    total: Counter[str] = Counter()
    for size in packages.values():
        total.update(size)
    return total


def _is_docstring(node: ast.AST) -> bool:
    """Return whether a node is a statement that consists of a text."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _is_number(value: ast.expr | None) -> bool:
    """Return whether an expression is a number or an arithmetic expression of numbers."""
    if isinstance(value, ast.UnaryOp):
        return _is_number(value.operand)
    if isinstance(value, ast.BinOp):
        return _is_number(value.left) and _is_number(value.right)
    return isinstance(value, ast.Constant) and type(value.value) in (int, float)


def main() -> None:
    """Print one row for each package, the largest first, and the total."""
    packages = measure_packages()
    rows = sorted(packages.items(), key=lambda item: -item[1]["nodes"])  # an item is a name and its counts
    print(f"{'package':40}" + "".join(f"{column:>12}" for column in COLUMNS))
    for name, size in [*rows, ("total", total_size(packages))]:
        print(f"{name:40}" + "".join(f"{size[column]:>12,}" for column in COLUMNS))


if __name__ == "__main__":
    main()
