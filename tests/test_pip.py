"""What pip installs: the base install into an empty environment serves a released model, without torch or scipy."""

import json
import re
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def predicted(bin_folder, folder):
    """The contact that the installed command computes."""
    table = "A,B,C\n942.9,910.4,690.8\n"
    words = [bin_folder / "isocharge", "serve", "predict", "three-25um-biaxial", "-", "--json"]
    done = subprocess.run(words, input=table, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    return [record["x_mm"], record["y_mm"], record["force_N"]]


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """The bin folder of an empty environment into which `pip install .` was done, with nothing else in it."""
    folder = tmp_path_factory.mktemp("fresh")
    venv.create(folder / "env")
    python = folder / "env" / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", python]
    subprocess.run([*pip, "install", "--quiet", "--no-compile", str(ROOT)], check=True, timeout=280)
    return python.parent


def run(base, *words, cwd):
    return subprocess.run(
        [base / words[0], *words[1:]], cwd=cwd, capture_output=True, text=True, timeout=60, check=False
    )


def test_nothing_heavy_came_along(base, tmp_path):
    code = "from importlib.metadata import distributions as all; print(*(one.name.lower() for one in all()))"
    names = {*run(base, "python", "-c", code, cwd=tmp_path).stdout.split()}
    assert {"isocharge", "numpy", "onnxruntime"} <= names
    assert not names & {"torch", "scipy", "scikit-learn", "onnx", "matplotlib"}


def test_predict_works_from_any_folder(base, tmp_path):
    assert predicted(base, tmp_path) == pytest.approx([3.0, -2.0, 1.0], abs=0.06)


@pytest.mark.parametrize(("page", "number"), [("README.md", 0), ("serve/README.md", 0), ("serve/README.md", 1)])
def test_examples_of_the_base_install_work_from_any_folder(base, tmp_path, page, number):
    """They print what their comments say with nothing but the base install."""
    example = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)[number]
    done = run(base, "python", "-c", example, cwd=tmp_path)
    assert done.stdout.splitlines() == re.findall(r"^print\(.*\)  # (.+)$", example, re.MULTILINE), done.stderr


@pytest.mark.parametrize("stage", ["simulate", "train"])
def test_a_missing_extra_says_so_in_python_too(base, tmp_path, stage):
    done = run(base, "python", "-c", f"import isocharge.{stage}", cwd=tmp_path)
    assert "isocharge.common.errors.MissingExtra" in done.stderr
    assert f"pip install 'isocharge[{stage}]'" in done.stderr


@pytest.mark.parametrize(
    ("words", "extra"),
    [
        ("simulate point three-25um-biaxial", "simulate"),
        ("serve http --port 0", "http"),
        ("serve stream three-25um-biaxial --port - --output touch.mcap", "record"),
        ("serve check three-25um-biaxial presses.parquet", "parquet"),
    ],
)
def test_a_missing_extra_says_how_to_get_it(base, tmp_path, words, extra):
    done = run(base, "isocharge", *words.split(), cwd=tmp_path)
    assert done.returncode == 1
    assert f"pip install 'isocharge[{extra}]'" in done.stderr
    assert "Traceback" not in done.stderr
