"""Names that say what a thing is: words that only say how it came to be, or nothing, are no names."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCES = sorted(path for portion in ("simulate", "train", "serve") for path in (ROOT / portion).rglob("*.py"))

EMPTY_NAMES = {"made", "found", "kept", "told", "there", "here", "own", "way", "felt", "wanted", "strange"}
"""`forward_map`, `crossing`, `checkpoint`, `known_force`, `position`: what it is."""

PUBLIC = {("fix.py", "found"), ("charge_curves.py", "own")}
"""Attributes of `Fix` and `Curves` that users may have written."""


def names_given(path: Path) -> Iterator[tuple[str, int]]:
    """Names of variables, parameters, attributes, functions and classes that a file makes, with their lines."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Name | ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield (node.id if isinstance(node, ast.Name) else node.attr), node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name, node.lineno


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_names_say_what_a_thing_is(path):
    empty = [(line, name) for name, line in names_given(path) if name.strip("_") in EMPTY_NAMES]
    assert [(line, name) for line, name in empty if (path.name, name) not in PUBLIC] == []


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_every_module_says_what_it_is(path):
    """The first sentence of a docstring: what a stranger reads in the tree."""
    docstring = ast.get_docstring(ast.parse(path.read_text("utf-8")))
    assert docstring
    assert docstring.split("\n\n")[0].rstrip().endswith((".", ":", "?"))
