"""The portions of one namespace: none hides another, serving stays light, no file names a machine."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("folder", ["simulate", "train", "serve"])
@pytest.mark.parametrize("namespace", ["isocharge", "isocharge/cli"])
def test_no_portion_hides_the_others(folder, namespace):
    assert not (ROOT / folder / namespace / "__init__.py").exists()


def run(code: str) -> str:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout


@pytest.mark.parametrize("portion", ["simulate", "train", "serve"])
def test_public_names_are_few_and_hide_no_module(portion):
    """`import isocharge.serve.stream as s` gives a module wherever there is one of that name."""
    folder = ROOT / portion / "isocharge" / portion
    modules = {path.stem for path in folder.iterdir()}
    names = json.loads(run(f"import json, isocharge.{portion} as face; print(json.dumps(face.__all__))"))
    assert len(names) <= 45
    assert not set(names) & modules


def test_serving_loads_nothing_heavy():
    code = "import json, sys; import isocharge.serve; isocharge.serve.Predictor; print(json.dumps([*sys.modules]))"
    loaded = set(json.loads(run(code)))
    assert "onnxruntime" in loaded
    assert not loaded & {"torch", "scipy", "sklearn", "onnx", "matplotlib", "typer", "rich"}
    assert not loaded & {"isocharge.simulate", "isocharge.train", "isocharge.cli"}


def test_no_file_names_a_machine():
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout.split()
    texts = [ROOT / name for name in tracked if name.endswith((".py", ".md", ".toml", ".json", "Makefile", "run"))]
    needles = ("/".join(["", "work", ""]), "/".join(["", "root", ""]), "/".join(["..", "shared"]))
    hits = [path.name for path in texts if path.is_file() for n in needles if n in path.read_text("utf-8")]
    assert hits == []
