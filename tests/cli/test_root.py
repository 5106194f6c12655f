"""What every command line has: a version, completion by the shell; and numbers as other programs write them."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ISOCHARGE = Path(sys.executable).parent / "isocharge"
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]


def run(*words, **variables):
    environment = os.environ | variables
    return subprocess.run(words, env=environment, capture_output=True, text=True, timeout=60, check=True).stdout


def test_version(command):
    assert command("--version") == (0, f"isocharge {VERSION}\n", "")


def test_the_module_is_the_command():
    assert run(sys.executable, "-m", "isocharge.cli", "--version") == run(ISOCHARGE, "--version")


@pytest.mark.parametrize("portion", ["simulate", "train", "serve"])
def test_version_of_a_portion(portion):
    """It costs nothing until it is asked for; other names are missing as ever."""
    code = (
        f"import sys, isocharge.{portion} as p; loaded = 'importlib.metadata' in sys.modules\n"
        "print(p.__version__, loaded, hasattr(p, 'nothing'))"
    )
    version, loaded, nothing = run(sys.executable, "-c", code).split()
    assert (version, nothing) == (VERSION, "False")
    assert loaded == "False" or portion != "serve"


@pytest.mark.parametrize(
    ("typed", "proposed"),
    [
        ("isocharge s", {"simulate", "serve"}),
        ("isocharge serve pr", {"predict"}),
        ("isocharge serve stream --po", {"--port", "--policy"}),
        ("isocharge serve stream --policy l", {"latest"}),
    ],
)
def test_the_shell_completes_what_is_typed(typed, proposed):
    words = {"COMP_WORDS": typed, "COMP_CWORD": str(len(typed.split()) - 1), "_ISOCHARGE_COMPLETE": "complete_bash"}
    assert set(run(ISOCHARGE, **words).split()) == proposed


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_for_a_shell_can_be_shown(shell):
    script = run(ISOCHARGE, "--show-completion", shell, _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1")
    assert f"complete_{shell}" in script
    assert "isocharge" in script


def test_completion_can_be_installed(tmp_path):
    run(ISOCHARGE, "--install-completion", "bash", HOME=str(tmp_path), _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1")
    (script,) = re.findall(r"source '?([^'\n]+)", (tmp_path / ".bashrc").read_text())
    assert "_ISOCHARGE_COMPLETE" in Path(script).read_text()


@pytest.mark.parametrize(
    ("words", "option", "text"),
    [
        (("serve", "virtual", "three-25um-biaxial", "--rate-Hz", "1_00"), "--rate-Hz", "1_00"),
        (("serve", "virtual", "three-25um-biaxial", "--rate-Hz=1_00"), "--rate-Hz", "1_00"),
        (("serve", "stream", "m", "--port", "p", "--count", "1_0"), "--count", "1_0"),
        (("serve", "check", "m", "f.csv", "--position-std", "0.0_5"), "--position-std", "0.0_5"),
        (("simulate", "sweep", "s", "--force", "0.05", "1_0", "-o", "x"), "--force", "1_0"),
        (("simulate", "point", "three-25um-biaxial", "--force", "\u0661"), "--force", "\u0661"),
    ],
)
def test_numbers_that_only_python_reads_are_none(command, words, option, text):
    code, out, err = command(*words)
    assert (code, out) == (2, "")
    assert option in err
    assert text in err or "valid" in err


def test_texts_may_have_underscores(command):
    code, _, err = command("serve", "stream", "1_0", "--port", "p")
    assert code == 2
    assert "ModelError: no model '1_0'" in err
