"""The house: portions of one namespace, packages that say what they may import, folders that stay small."""

import ast
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HOMES = {"simulate": "simulate", "train": "train", "serve": "serve", "cli": "serve"}
"""Portion of the namespace to the top-level folder that holds it."""

MOST_MODULES = 13
MOST_ARROWS = {"simulate": 55, "serve": 32, "train": 20, "cli": 10}
"""Arrows between the packages of a portion, its face left out."""

OUTSIDE = {"isocharge.cli", "isocharge.serve.flags"}
"""Modules beside the packages of their portion."""


def source(portion: str) -> Path:
    return ROOT / HOMES[portion] / "isocharge" / portion


def package_folders(portion: str) -> list[Path]:
    """Folders with modules, the portion's own left out."""
    return sorted(path.parent for path in source(portion).rglob("__init__.py") if path.parent != source(portion))


def name_of(portion: str, path: Path) -> str:
    """Of a package or module within its portion: "network.http"."""
    return ".".join(path.relative_to(source(portion)).with_suffix("").parts)


PACKAGES = [(portion, name_of(portion, folder)) for portion in HOMES for folder in package_folders(portion)]


def imported_by(path: Path) -> Iterator[str]:
    """Modules of isocharge that a file imports, also inside functions."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.startswith("isocharge."))
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.startswith("isocharge"):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def package_of(dotted: str, portion: str) -> str | None:
    """The package of a portion in which an imported name lives: the longest that fits; None for another portion."""
    if not f"{dotted}.".startswith(f"isocharge.{portion}."):
        return None
    inner = dotted.removeprefix(f"isocharge.{portion}").lstrip(".")
    fitting = [name for kind, name in PACKAGES if kind == portion and f"{inner}.".startswith(f"{name}.")]
    return max(fitting, key=len) if fitting else inner.partition(".")[0]


def imports_of(portion: str, package: str) -> set[str]:
    """Packages of its own portion that a package imports."""
    folder = source(portion) / package.replace(".", "/")
    used = {package_of(dotted, portion) for path in folder.glob("*.py") for dotted in imported_by(path)}
    return {name for name in used if name is not None} - {package, "main"}


def docstring(portion: str, package: str) -> str:
    path = source(portion) / package.replace(".", "/") / "__init__.py"
    return ast.get_docstring(ast.parse(path.read_text("utf-8"))) or ""


@pytest.mark.parametrize("portion", ["simulate", "train", "serve"])
def test_no_portion_hides_the_others(portion):
    assert not (ROOT / portion / "isocharge" / "__init__.py").exists()


@pytest.mark.parametrize(("portion", "package"), PACKAGES)
def test_a_package_says_what_it_is_and_imports_what_it_says(portion, package):
    """Its docstring has a line "May import: a, b."; every import of its own portion is in it."""
    text = docstring(portion, package)
    first, rule = text.split("\n", 1)[0], re.search(r"^May import: (.+?)\.$", text, re.MULTILINE | re.DOTALL)
    assert first.endswith(".")
    assert rule, f"the docstring of {portion}.{package} has no line 'May import: ...'"
    nothing = rule[1] == f"nothing else of isocharge.{portion}"
    allowed = set() if nothing else set(re.split(r",\s+", rule[1]))
    assert allowed <= {name for kind, name in PACKAGES if kind == portion} | {"flags"}
    assert imports_of(portion, package) <= allowed


@pytest.mark.parametrize("portion", HOMES)
def test_packages_are_few_and_know_few(portion):
    arrows = {(package, used) for kind, package in PACKAGES if kind == portion for used in imports_of(portion, package)}
    assert len(arrows) <= MOST_ARROWS[portion]


@pytest.mark.parametrize("portion", HOMES)
def test_no_folder_is_crowded(portion):
    for folder in [source(portion).parent, source(portion), *package_folders(portion)]:
        modules = [path.name for path in folder.glob("*.py") if path.name != "__init__.py"]
        assert len(modules) <= MOST_MODULES, f"{folder.relative_to(ROOT)}: {sorted(modules)}"


@pytest.mark.parametrize("portion", ["simulate", "train", "serve"])
def test_tests_mirror_the_packages(portion):
    """A folder of tests is named after a package; what belongs to a whole portion lies beside them."""
    packages = {name_of(portion, folder).replace(".", "/") for folder in package_folders(portion)} | {"cli"}
    here = ROOT / "tests" / portion
    folders = {path.parent.relative_to(here).as_posix() for path in here.rglob("test_*.py")} - {"."}
    assert folders <= packages


def test_the_shared_ground_knows_no_portion():
    for path in (ROOT / "serve" / "isocharge").glob("*.py"):
        assert not {name for name in imported_by(path) if name.split(".")[1] in HOMES}, path.name


@pytest.mark.parametrize("portion", HOMES)
def test_imports_inside_functions_hide_no_circle(portion):
    """Only the command line imports late, to answer `--help` at once; elsewhere imports stand at the top."""
    if portion == "cli":
        return
    for path in source(portion).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                inside = [n for n in ast.walk(node) if isinstance(n, ast.ImportFrom) and n.module]
                assert not [n.module for n in inside if n.module.startswith("isocharge")], path


def test_no_public_name_hides_a_module():
    """`import isocharge.serve.stream as s` gives a module wherever there is one of that name."""
    for portion in ("simulate", "train", "serve"):
        inner = source(portion)
        modules = {path.stem for path in inner.glob("*.py")} | {path.name for path in inner.iterdir() if path.is_dir()}
        code = f"import json, isocharge.{portion} as face; print(json.dumps(face.__all__))"
        assert not set(json.loads(run(code))) & modules


def run(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


def loaded_after(statement: str) -> set[str]:
    """Modules in a fresh interpreter, packages of isocharge with their portion."""
    return set(json.loads(run(f"import json, sys; {statement}; print(json.dumps(sorted(sys.modules)))")))


def test_serving_loads_nothing_heavy():
    loaded = loaded_after("import isocharge.serve; isocharge.serve.Predictor")
    assert "onnxruntime" in loaded
    assert not loaded & {"torch", "scipy", "sklearn", "onnx", "matplotlib", "typer", "rich"}
    assert not loaded & {"isocharge.simulate", "isocharge.train", "isocharge.cli"}


@pytest.mark.parametrize("module", ["isocharge.cli", "isocharge.cli.serve.predict"])
def test_help_loads_no_stage(module):
    loaded = loaded_after(f"import {module}")
    assert not loaded & {"numpy", "onnxruntime", "torch", "scipy", "matplotlib", "serial"}


def test_no_file_names_a_machine():
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout.split()
    texts = [ROOT / name for name in tracked if name.endswith((".py", ".md", ".toml", ".json", "Makefile", "run"))]
    needles = ("/".join(["", "work", ""]), "/".join(["", "root", ""]), "/".join(["..", "shared"]))
    hits = [path.name for path in texts if path.is_file() for n in needles if n in path.read_text("utf-8")]
    assert hits == []
