"""A command that needs an extra names the install command, and no command ends in a traceback without extras."""

import json
import re
import subprocess
import sys

import pytest

from cli.test_help import COMMANDS
from extras import PACKAGES
from processes import finished

BASE_COMMANDS = {
    "serve predict",
    "serve check",
    "serve stream",
    "serve replay",
    "serve doctor",
    "serve bench",
    "verify",
}
"""Commands that the base install runs. Their examples name files and ports that do not exist here."""

EXTRAS = {"serve http": "http", "serve plot": "simulate", "serve virtual": "simulate", "simulate design": "design"}
"""The extra of each command that is not that of its group."""

OPTIONS = {
    "demo --live 0": "simulate,http",
    "serve stream three-25um-biaxial --port - --live 0": "http",
    "serve stream three-25um-biaxial --port - --output touch.mcap": "record",
}
"""Extra that a command line needs for one of its options."""

RUN_ALL = """
import sys
from isocharge.cli.main import main

for line in sys.argv[1:]:
    sys.argv = ["isocharge", *line.split()]
    try:
        main()
    except SystemExit as end:
        print("exit code", end.code or 0, file=sys.stderr)
"""
"""Runs command lines one after the other, in one process, which imports the packages only once."""

LOAD_ALL = """
import json
import os
import sys

absent_packages = json.loads(sys.argv[1])
outcomes = {}


class AbsentPackages:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in absent:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def load(group, path):
    for name in group.list_commands(None):
        words = [*path, name]
        try:
            _, command, _ = group.resolve_command(None, [name])
        except MissingExtra as error:
            outcomes[" ".join(words)] = str(error)
            continue
        if hasattr(command, "list_commands"):
            load(command, words)
        else:
            outcomes[" ".join(words)] = ""


if len(absent_packages) > 2:
    import ezdxf, matplotlib.figure, onnx, onnxruntime, rich.markdown, shapely, torch, typer
    import scipy.optimize, scipy.spatial, scipy.stats
    import sklearn.ensemble, sklearn.gaussian_process, sklearn.neighbors

for extra, absent in absent_packages.items():
    if os.fork():
        _, status = os.wait()
        assert status == 0, extra
        continue
    is_usable = {"sklearn": "scipy" not in absent}  # scikit-learn cannot be imported without SciPy
    for name in [*sys.modules]:
        package = name.partition(".")[0]
        if package in absent or not is_usable.get(package, True):
            del sys.modules[name]
    sys.meta_path.insert(0, AbsentPackages())
    import typer
    from isocharge.cli.main import app
    from isocharge.common.errors import MissingExtra

    load(typer.main.get_command(app), [])
    print(json.dumps([extra, outcomes]), flush=True)
    os._exit(0)
"""
"""Loads all commands in one process for each extra, with the packages of this extra absent.

Several processes are forked after the large packages are imported, because this takes longer than everything else.
"""


ABSENT_PACKAGES = PACKAGES | {"every extra": set().union(*PACKAGES.values())}
"""Packages that are absent without an extra; "every extra" for the base install."""


def extra_of(command):
    group = command.split()[0]
    return EXTRAS.get(command, "train" if group == "demo" else group)


@pytest.fixture
def run(installed, tmp_path):
    """Return a function that runs command lines in the base install, and returns their messages and exit codes."""

    def run_lines(*lines):
        words = [sys.executable, "-c", RUN_ALL, *lines]
        done = finished(words, env=installed(), cwd=tmp_path, stdin=subprocess.DEVNULL, timeout=100)
        assert "Traceback" not in done.stderr, done.stderr
        return re.findall(r"(.*?)exit code (\d)\n", done.stderr, re.DOTALL)

    return run_lines


def test_options_in_the_base_install_name_the_install_command(run):
    for (message, code), extra in zip(run(*OPTIONS), OPTIONS.values(), strict=True):
        assert code == "1"
        assert f"pip install 'isocharge[{extra}]'" in message


@pytest.fixture(scope="module")
def outcomes_without(installed, request):
    """The message of each command, or "" if it is imported, for each extra that is missing in a test that runs."""
    wanted = {item.callspec.params["missing"] for item in request.session.items if "missing" in item.fixturenames}
    absent = {extra: sorted(packages) for extra, packages in ABSENT_PACKAGES.items() if extra in wanted}
    done = finished([sys.executable, "-c", LOAD_ALL, json.dumps(absent)], env=installed("all"), timeout=290)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(line) for line in done.stdout.splitlines())


@pytest.mark.parametrize(
    "missing",
    [
        pytest.param(extra, marks=[] if extra in {"simulate", "every extra"} else [pytest.mark.slow])
        for extra in ABSENT_PACKAGES
    ],
)
def test_commands_are_imported_or_name_the_one_extra_that_is_missing(missing, outcomes_without):
    """Every command in an install that has all packages but those of one extra, and in the base install."""
    outcomes = outcomes_without[missing]
    assert outcomes.keys() == COMMANDS.keys()
    for command, message in outcomes.items():
        if message:
            assert f"pip install 'isocharge[{extra_of(command)}]'" in message
            assert PACKAGES[extra_of(command)] & ABSENT_PACKAGES[missing]
    if missing == "every extra":
        imported = {command for command, message in outcomes.items() if not message}
        assert imported == BASE_COMMANDS | {"demo"}  # the base install writes the playground of the demo


def test_the_base_install_writes_the_playground(run, tmp_path):
    first, (message, code) = run(*["demo --playground pages/playground.html"] * 2)
    assert first == ("wrote pages/playground.html; open it in a browser\n", "0")
    assert ("is already there" in message, code) == (True, "1")
    text = (tmp_path / "pages" / "playground.html").read_text("utf-8")
    assert text.startswith("<!doctype html>")
    assert "{{data}}" not in text
