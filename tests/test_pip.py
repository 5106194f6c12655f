"""What pip installs: the base install into an empty environment serves a released model, without torch or scipy.

In `make test-all` wheel and sdist on every Python at hand, and every `pip install` line of the pages, too.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
MODELS = sorted(path.name for path in (ROOT / "models").iterdir() if path.is_dir())
PAGES = {
    path.relative_to(ROOT).as_posix(): path.read_text("utf-8")
    for pattern in ("*.md", "*/README.md", "*/docs/*.md")
    for path in sorted(ROOT.glob(pattern))
}
LINES = sorted(
    {"."} | {line for text in PAGES.values() for line in re.findall(r"'((?:\.|isocharge)\[[\w,]+\])'", text)}
)
"""What the pages tell people to install of ours."""

NEEDED = {"": "isocharge.serve", "http": "uvloop", "grpc": "grpc", "simulate": "isocharge.simulate"}
NEEDED |= {"train": "isocharge.train", "all": "isocharge.train", "cluster": "distributed"}
"""What can be imported once an extra is installed."""


def interpreter(version):
    """A Python of this version, None if this machine has none."""
    beside = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    for candidate in (*beside, shutil.which(f"python{version}")):
        if candidate and _version_of(candidate) == version:
            return Path(candidate)
    return None


def _version_of(python):
    code = "import sys, ensurepip; print('{}.{}'.format(*sys.version_info))"
    done = subprocess.run([python, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    return done.stdout.strip()


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Wheel and sdist, built from the tracked files in an environment with nothing but the build backend."""
    folder = tmp_path_factory.mktemp("built")
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split(
        "\n"
    )
    for name in filter(None, tracked):
        (folder / "src" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / "src" / name)
    venv.create(folder / "env", with_pip=True)
    python = folder / "env/bin/python"
    subprocess.run([python, "-m", "pip", "install", "--quiet", "hatchling"], check=True, timeout=300)
    subprocess.run(
        [python, "-m", "hatchling", "build", "-d", folder / "out"], cwd=folder / "src", check=True, timeout=300
    )
    (wheel,), (sdist,) = (folder / "out").glob("*.whl"), (folder / "out").glob("*.tar.gz")
    return wheel, sdist


@pytest.fixture
def fresh(tmp_path):
    """A function that makes an empty environment with a Python: its bin folder."""

    def make(python=sys.executable):
        subprocess.run([python, "-m", "venv", tmp_path / "env"], check=True, timeout=300)
        return tmp_path / "env/bin"

    return make


def pip_install(bin_folder, what):
    done = subprocess.run(
        [bin_folder / "python", "-m", "pip", "install", "--quiet", what],
        capture_output=True,
        text=True,
        timeout=1800,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]


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
        ("serve stream three-25um-biaxial --port - --mcap touch.mcap", "record"),
        ("serve check three-25um-biaxial presses.parquet", "parquet"),
    ],
)
def test_a_missing_extra_says_how_to_get_it(base, tmp_path, words, extra):
    done = run(base, "isocharge", *words.split(), cwd=tmp_path)
    assert done.returncode == 1
    assert f"pip install 'isocharge[{extra}]'" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
def test_wheel_and_sdist_hold_the_models_and_nothing_of_ours_alone(built):
    wheel, sdist = built
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
    assert {name.split("/")[3] for name in names if name.startswith("isocharge/serve/released/")} == set(MODELS)
    assert {name.split("/")[0] for name in names} == {"isocharge", f"{wheel.name.split('-py3')[0]}.dist-info"}
    with tarfile.open(sdist) as archive:
        held = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "LICENSE", "README.md", "serve/deploy/Containerfile"} <= held
    assert not any(name.startswith((".venv", "build")) for name in held)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", ["wheel", "sdist"])
@pytest.mark.parametrize("version", PYTHONS)
def test_the_base_install_predicts_on(version, kind, built, fresh, tmp_path):
    python = interpreter(version)
    if python is None:
        pytest.skip(f"this machine has no Python {version} with ensurepip")
    bin_folder = fresh(python)
    pip_install(bin_folder, built[0] if kind == "wheel" else built[1])
    assert predicted(bin_folder, tmp_path) == pytest.approx([3.0, -2.0, 1.0], abs=0.06)
    done = subprocess.run([bin_folder / "isocharge", "--help"], capture_output=True, timeout=60, check=False)
    assert done.returncode == 0


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("line", LINES)
def test_a_line_of_the_pages_installs_what_it_says(line, built, fresh, tmp_path):
    """The wheel stands for the folder or the name."""
    extra = "".join(re.findall(r"\[([\w,]+)\]", line))
    if extra in ("train", "all") and not os.environ.get("ISOCHARGE_TEST_TORCH"):
        pytest.skip("installs torch, which takes gigabytes from some indexes; $ISOCHARGE_TEST_TORCH=1 runs it")
    bin_folder = fresh()
    pip_install(bin_folder, f"{built[0]}[{extra}]" if extra else built[0])
    code = f"import {NEEDED[extra]}"
    assert subprocess.run([bin_folder / "python", "-c", code], cwd=tmp_path, timeout=300, check=False).returncode == 0
    assert predicted(bin_folder, tmp_path) == pytest.approx([3.0, -2.0, 1.0], abs=0.06)
