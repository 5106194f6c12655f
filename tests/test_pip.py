"""What pip installs: wheel and sdist on every Python at hand, and every `pip install` line of the pages."""

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

pytestmark = [pytest.mark.slow, pytest.mark.timeout(3600)]


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


@pytest.mark.parametrize("version", PYTHONS)
@pytest.mark.parametrize("extra", ["", "http", "grpc", "simulate"])
def test_wheels_of_every_dependency_exist_for(version, extra, built, tmp_path):
    """pip finds a binary of each for this Python, also where the machine has no such Python."""
    what = f"{built[0]}[{extra}]" if extra else str(built[0])
    report = tmp_path / "report.json"
    words = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed", "--report", report]
    words += ["--only-binary=:all:", "--python-version", version, "--target", tmp_path / "none", what]
    done = subprocess.run(words, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    names = {entry["metadata"]["name"].lower() for entry in json.loads(report.read_text())["install"]}
    assert {"isocharge", "numpy", "onnxruntime"} <= names


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
