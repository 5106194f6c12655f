"""The layout that the packages, type checker and editable installs rest on."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PORTIONS = ("simulate", "train", "serve")


@pytest.mark.parametrize("portion", PORTIONS)
def test_no_portion_hides_the_others(portion):
    assert not (ROOT / portion / "isocharge" / "__init__.py").exists()


def loaded_after(statement: str) -> set[str]:
    code = f"import json, sys; {statement}; print(json.dumps(sorted({{m.partition('.')[0] for m in sys.modules}})))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(json.loads(run.stdout))


def test_serving_loads_nothing_heavy():
    loaded = loaded_after("import isocharge.serve; isocharge.serve.Predictor")
    assert "onnxruntime" in loaded
    assert not loaded & {"torch", "scipy", "sklearn", "onnx", "matplotlib"}


def test_help_loads_no_stage():
    loaded = loaded_after("import isocharge.cli")
    assert not loaded & {"numpy", "onnxruntime", "torch", "scipy", "matplotlib"}


def test_no_file_names_a_machine():
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False).stdout.split()
    texts = [ROOT / name for name in tracked if name.endswith((".py", ".md", ".toml", ".json", "Makefile", "run"))]
    needles = ("/".join(["", "work", ""]), "/".join(["", "root", ""]), "/".join(["..", "shared"]))
    hits = [path.name for path in texts if path.is_file() for n in needles if n in path.read_text("utf-8")]
    assert hits == []
