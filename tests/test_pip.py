"""What pip installs: the wheel in an empty environment serves a released model, without torch or scipy.

The slow tests build the wheel from the source distribution, and install the dependencies, too.
"""

import json
import re
import subprocess
import sys
import sysconfig
import tomllib
import venv

import pytest
import yaml

from kept import ROOT
from processes import finished

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
VERSION = PROJECT["version"]

COMMANDS_OF_EXTRAS = {
    "simulate": "simulate point three-25um-biaxial --at 1,2 --force 1",
    "train": "train fit --help",
    "http": "serve http --help",
    "grpc": "serve http --help",
    "cluster": "simulate sweep --help",
    "design": "simulate design --help",
    "record": "serve stream three-25um-biaxial --port frames.txt --output touch.mcap",
    "all": "simulate design --help",
}
"""A command that imports the packages of each extra. It runs in an install with this extra only."""


def check_prediction(bin_folder, folder, **options):
    """Check the contact that the installed command computes."""
    words = ("serve", "predict", "three-25um-biaxial", "-", "--json")
    done = run(bin_folder, "isocharge", *words, input="A,B,C\n942.9,910.4,690.8\n", cwd=folder, **options)
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert [record["x_mm"], record["y_mm"], record["force_N"]] == pytest.approx([3.0, -2.0, 1.0], abs=0.06)


def build(folder, *options):
    """Build distributions in a folder, and return their paths."""
    words = [sys.executable, "-m", "build", *options, "-o", folder, ROOT]
    subprocess.run(words, check=True, timeout=280, capture_output=True)
    return sorted(folder.iterdir())


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel."""
    return build(tmp_path_factory.mktemp("dist"), "--wheel")[0]


BASE_TESTS = (
    "tests/cli/test_help.py",
    "tests/serve/frames",
    "tests/serve/model",
    "tests/serve/network/grpc",
    "tests/serve/network/http/test_server.py",
    "tests/serve/prediction",
    "tests/serve/record",
    "tests/serve/signal_chain",
    "tests/simulate/sensor",
    "tests/test_structs.py",
)
"""Tests that run with the lower bounds of all packages. They need only the extra `all` and `TEST_PACKAGES`."""

TEST_PACKAGES = (
    "anyio",
    "crcmod",
    "filelock",
    "hypothesis",
    "jsonschema-rs",
    "pytest",
    "pytest-timeout",
    "pytest-xdist",
    "trustme",
)
"""Packages that the tests import, in their newest versions."""


def install(requirements, folder, timeout, constraints=""):
    """Install requirements into an empty environment, and return the bin folder of the environment."""
    venv.create(folder / "env")
    python = folder / "env" / "bin" / "python"
    constraint_file = folder / "constraints.txt"
    constraint_file.write_text(constraints)
    pip = [sys.executable, "-m", "pip", "--python", python]
    options = ["--quiet", "--no-compile", "--constraint", constraint_file]
    subprocess.run([*pip, "install", *options, *requirements], check=True, timeout=timeout)
    return python.parent


def lower_bounds():
    """Constraints with which pip installs the smallest allowed version of each package.

    Torch is left out, because it is too large to be installed in a second version.
    """
    extras = PROJECT["optional-dependencies"]
    requirements = [*PROJECT["dependencies"], *(line for name in COMMANDS_OF_EXTRAS for line in extras[name])]
    bounds = (re.match(r"([\w-]+)>=([\d.]+)", line) for line in requirements)
    return "".join(f"{bound[1]}=={bound[2]}\n" for bound in bounds if bound and bound[1] != "torch")


@pytest.fixture(scope="module")
def base(tmp_path_factory, wheel):
    """The bin folder of an empty environment into which the wheel was installed. It finds the packages of this one."""
    bin_folder = install(["--no-deps", wheel], tmp_path_factory.mktemp("fresh"), timeout=280)
    (site_packages,) = bin_folder.parent.glob("lib/*/site-packages")
    (site_packages / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    return bin_folder


def run(base, program, *words, timeout=60, **options):
    """Run a program of an environment to its end."""
    return finished([base / program, *words], timeout=timeout, **options)


def check_example(bin_folder, folder, page, number, **options):
    """Check that a Python example of a page prints what its comments say."""
    example = re.findall(r"```python\n(.*?)```", (ROOT / page).read_text("utf-8"), re.DOTALL)[number]
    done = run(bin_folder, "python", "-c", example, cwd=folder, **options)
    assert done.stdout.splitlines() == re.findall(r"^print\(.*\)  # (.+)$", example, re.MULTILINE), done.stderr


@pytest.mark.slow
def test_twine_accepts_both_distributions_and_nothing_heavy_is_installed(tmp_path):
    """The size does not include compiled Python modules, which are a tenth of the stated size."""
    distributions = build(tmp_path / "dist")
    assert len(distributions) == 2
    done = finished([sys.executable, "-m", "twine", "check", "--strict", *distributions], timeout=60)
    assert done.returncode == 0, done.stdout + done.stderr

    bin_folder = install(distributions[:1], tmp_path, timeout=280)
    code = "from importlib.metadata import distributions as all; print(*(one.name.lower() for one in all()))"
    names = {*run(bin_folder, "python", "-c", code, cwd=tmp_path).stdout.split()}
    assert {"isocharge", "numpy", "onnxruntime"} <= names
    assert not names & {"torch", "scipy", "scikit-learn", "onnx", "matplotlib"}

    page = (ROOT / "serve/docs/getting_started.md").read_text("utf-8")
    stated_MB = float(re.search(r"^\| none \|.*\| (\d+) MB \|$", page, re.MULTILINE)[1])
    size_MB = sum(path.stat().st_size for path in bin_folder.parent.rglob("*") if path.is_file()) / 2**20
    assert 0.7 * stated_MB < size_MB < 1.05 * stated_MB


def test_the_version_is_that_of_the_changelog_and_of_the_citation():
    assert re.search(r"^## (\S+?),? ", (ROOT / "CHANGELOG.md").read_text("utf-8"), re.MULTILINE)[1] == VERSION
    assert f"\nversion: {VERSION}\n" in (ROOT / "CITATION.cff").read_text("utf-8")


def test_the_conda_recipe_has_the_version_and_the_requirements_of_the_package():
    recipe = yaml.safe_load((ROOT / ".ci/conda/recipe.yaml").read_text("utf-8"))
    packages = [line for line in recipe["requirements"]["run"] if not line.startswith(("python ", "__unix"))]
    assert [line.replace(" ", "") for line in packages] == PROJECT["dependencies"]
    assert recipe["context"]["version"] == VERSION
    assert f">={recipe['context']['python_min']}" == PROJECT["requires-python"]


def test_commands_and_examples_of_the_base_install_work_from_any_folder(base, tmp_path, installed):
    """The example prints what its comments say in an installation without extras."""
    check_prediction(base, tmp_path, env=installed("base"))
    check_example(base, tmp_path, "serve/docs/tutorial.md", 1, env=installed("base"))


@pytest.mark.parametrize("stage", ["simulate", "train"])
def test_a_missing_extra_says_so_in_python_too(base, tmp_path, stage, installed):
    done = run(base, "python", "-c", f"import isocharge.{stage}", cwd=tmp_path, env=installed("base"))
    assert "isocharge.common.errors.MissingExtra" in done.stderr
    assert f"pip install 'isocharge[{stage}]'" in done.stderr


def check_help_and_missing_argument(bin_folder, folder):
    """Check what typer and click print."""
    for command in ("", "serve stream", "serve predict"):
        done = run(bin_folder, "isocharge", *command.split(), "--help", cwd=folder)
        assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr
        assert "\\[" not in done.stdout, "an escaped bracket was printed as it is"
    done = run(bin_folder, "isocharge", "serve", "predict", cwd=folder)
    assert (done.returncode, "Missing argument 'MODEL'" in done.stderr) == (2, True), done.stderr


@pytest.mark.slow
def test_the_base_install_works_with_the_lower_bounds_of_its_packages(wheel, tmp_path):
    bin_folder = install([wheel], tmp_path, timeout=280, constraints=lower_bounds())
    check_prediction(bin_folder, tmp_path)
    check_help_and_missing_argument(bin_folder, tmp_path)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_base_tests_pass_with_the_lower_bounds_of_all_packages(tmp_path):
    """Warnings are no errors here, because old versions of packages warn of new versions of their own packages."""
    requirements = ["--editable", f"{ROOT}[all]", *TEST_PACKAGES]
    bin_folder = install(requirements, tmp_path, 3000, lower_bounds())
    options = ["-o", "addopts=--import-mode=importlib", "-o", "filterwarnings=default", "-m", "not slow"]
    words = [bin_folder / "python", "-m", "pytest", "-n", "2", *options, *BASE_TESTS]
    words += ["--ignore", "tests/serve/model/test_conformance.py"]  # needs a newer protobuf
    words += ["--deselect", "tests/serve/network/grpc/test_service.py::test_compiled_protocol_file_equals_the_source"]
    done = finished(words, cwd=ROOT, timeout=3000)
    assert done.returncode == 0, done.stdout


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("constraints", ["", lower_bounds()])
@pytest.mark.parametrize("extra", sorted(COMMANDS_OF_EXTRAS))
def test_the_wheel_with_an_extra_runs_the_readme_and_a_command_of_the_extra(wheel, tmp_path, extra, constraints):
    bin_folder = install([f"{wheel}[{extra}]"], tmp_path, 3000, constraints)
    check_example(bin_folder, tmp_path, "README.md", 0)
    (tmp_path / "frames.txt").write_text("942.9,910.4,690.8\n" * 200)
    done = run(bin_folder, "isocharge", *COMMANDS_OF_EXTRAS[extra].split(), cwd=tmp_path, timeout=600)
    assert done.returncode == 0, done.stderr


def test_every_extra_has_a_command():
    assert {*COMMANDS_OF_EXTRAS, "dev"} == {*PROJECT["optional-dependencies"]}
