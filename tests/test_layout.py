"""The packages of one namespace: none hides another, serving stays light, no file names a machine."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import isocharge.serve
import isocharge.simulate
import isocharge.train

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("folder", ["simulate", "train", "serve"])
@pytest.mark.parametrize("namespace", ["isocharge", "isocharge/cli"])
def test_no_package_hides_the_others(folder, namespace):
    assert not (ROOT / folder / namespace / "__init__.py").exists()


@pytest.mark.parametrize("face", [isocharge.simulate, isocharge.train, isocharge.serve])
def test_public_names_are_few_and_hide_no_module(face):
    """`import isocharge.serve.model as m` gives a module wherever there is one of that name."""
    modules = {path.stem for path in Path(face.__file__).parent.iterdir()}
    assert len(face.__all__) <= 45
    assert not set(face.__all__) & modules


def test_serving_loads_nothing_heavy():
    code = "import json, sys; import isocharge.serve; isocharge.serve.Predictor; print(json.dumps([*sys.modules]))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(json.loads(done.stdout))
    assert "onnxruntime" in loaded
    assert not loaded & {"torch", "scipy", "sklearn", "onnx", "matplotlib", "typer", "rich"}
    assert not loaded & {"isocharge.simulate", "isocharge.train", "isocharge.cli"}


def test_no_file_names_a_machine():
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout.split()
    texts = [ROOT / name for name in tracked if name.endswith((".py", ".md", ".toml", ".json", "Makefile", "run"))]
    needles = ("/".join(["", "work", ""]), "/".join(["", "root", ""]), "/".join(["..", "shared"]))
    hits = [path.name for path in texts if path.is_file() for n in needles if n in path.read_text("utf-8")]
    assert hits == []
