"""A fresh machine: the base install into an empty environment serves a released model, without torch or scipy."""

import json
import re
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """The bin folder of an empty environment into which `pip install .` was done, with nothing else in it."""
    folder = tmp_path_factory.mktemp("fresh")
    venv.create(folder / "env")
    python = folder / "env" / "bin" / "python"
    pip = [sys.executable, "-m", "pip", "--python", python]
    subprocess.run([*pip, "install", "--quiet", "--no-compile", str(ROOT)], check=True, timeout=280)
    return python.parent


def run(fresh, *words, cwd, stdin=None):
    return subprocess.run(
        [fresh / words[0], *words[1:]], cwd=cwd, input=stdin, capture_output=True, text=True, timeout=60, check=False
    )


def test_nothing_heavy_came_along(fresh, tmp_path):
    code = "from importlib.metadata import distributions as all; print(*(one.name.lower() for one in all()))"
    names = {*run(fresh, "python", "-c", code, cwd=tmp_path).stdout.split()}
    assert {"isocharge", "numpy", "onnxruntime"} <= names
    assert not names & {"torch", "scipy", "scikit-learn", "onnx", "matplotlib"}


def test_predict_works_from_any_folder(fresh, tmp_path):
    table = "A,B,C\n942.9,910.4,690.8\n"
    done = run(fresh, "isocharge", "serve", "predict", "three-25um-biaxial", "-", "--json", cwd=tmp_path, stdin=table)
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert [record["x_mm"], record["y_mm"], record["force_N"]] == pytest.approx([3.0, -2.0, 1.0], abs=0.06)
    assert record["model"] == "three-25um-biaxial/1"


@pytest.mark.parametrize(("page", "number"), [("README.md", 0), ("serve/README.md", 0), ("serve/README.md", 1)])
def test_examples_of_the_base_install_work_from_any_folder(fresh, tmp_path, page, number):
    """They print what their comments say with nothing but the base install."""
    example = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)[number]
    done = run(fresh, "python", "-c", example, cwd=tmp_path)
    assert done.stdout.splitlines() == re.findall(r"^print\(.*\)  # (.+)$", example, re.MULTILINE), done.stderr


def test_licence_and_readme_came_along(fresh, tmp_path):
    code = (
        "import importlib.metadata as m; d = m.metadata('isocharge'); print(d['License-Expression'], d['License-File'])"
    )
    assert run(fresh, "python", "-c", code, cwd=tmp_path).stdout.split() == ["BSD-3-Clause", "LICENSE"]


@pytest.mark.parametrize("stage", ["simulate", "train"])
def test_a_missing_extra_says_so_in_python_too(fresh, tmp_path, stage):
    done = run(fresh, "python", "-c", f"import isocharge.{stage}", cwd=tmp_path)
    assert "isocharge.common.errors.MissingExtra" in done.stderr
    assert f"pip install 'isocharge[{stage}]'" in done.stderr


@pytest.mark.parametrize(
    ("words", "extra"), [("simulate point three-25um-biaxial", "simulate"), ("serve http --port 0", "http")]
)
def test_a_missing_extra_says_how_to_get_it(fresh, tmp_path, words, extra):
    done = run(fresh, "isocharge", *words.split(), cwd=tmp_path)
    assert done.returncode == 1
    assert f"pip install 'isocharge[{extra}]'" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("extras", "present", "absent"),
    [
        (("base",), ("onnxruntime", "serial", "typer"), ("scipy", "matplotlib", "torch", "uvloop", "grpc", "dask")),
        (("simulate",), ("scipy", "matplotlib"), ("torch", "sklearn", "onnx", "uvloop", "dask")),
        (("train",), ("scipy", "torch", "onnx"), ("uvloop", "grpc", "dask")),
        (("http",), ("uvloop",), ("scipy", "grpc")),
        (("grpc",), ("uvloop", "grpc"), ("scipy", "torch")),
        (("all",), ("scipy", "torch", "grpc", "dask"), ()),
    ],
)
def test_the_examples_of_a_page_find_the_packages_of_its_install_only(installed, extras, present, absent):
    code = (
        "import sys\nfrom importlib.util import find_spec\nfor name in sys.argv[1:]:\n"
        "    try:\n        assert find_spec(name)\n    except ModuleNotFoundError as error:\n        print(error.name)"
    )
    words = [sys.executable, "-c", code, *present, *absent]
    done = subprocess.run(words, env=installed(*extras), capture_output=True, text=True, check=True)
    assert done.stdout.split() == [*absent]
