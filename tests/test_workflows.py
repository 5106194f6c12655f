"""Workflows of GitHub Actions: their steps are commands that run here, and their actions are pinned."""

import re
import shutil
import sys
from pathlib import Path

import pytest
import yaml

from kept import ROOT
from processes import finished

WORKFLOWS = sorted((ROOT / ".github/workflows").glob("*.yml"))
TARGETS = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
BIN = Path(sys.executable).parent


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_each_step_is_a_target_of_make_or_a_script(workflow):
    for job in yaml.safe_load(workflow.read_text("utf-8"))["jobs"].values():
        targets = job.get("strategy", {}).get("matrix", {}).get("target", [])
        for command in (step["run"] for step in job["steps"] if "run" in step):
            program, argument = command.split()[:2]
            if program == "make":
                assert {argument} <= TARGETS or (argument == '"$TARGET"' and {*targets} <= TARGETS), command
            else:
                assert (program, (ROOT / argument).is_file()) == ("python", True), command


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.name)
def test_each_action_is_pinned_to_a_commit_with_its_version_in_a_comment(workflow):
    uses = re.findall(r"^ +-? *uses: (.*)$", workflow.read_text("utf-8"), re.MULTILINE)
    assert uses
    assert all(re.fullmatch(r"[\w./-]+@[0-9a-f]{40} # v\d+\.\d+\.\d+", use) for use in uses), uses


def test_zizmor_finds_nothing():
    words = [BIN / "zizmor", "--offline", "--pedantic", *WORKFLOWS]
    done = finished(words, timeout=60)
    assert done.returncode == 0, done.stdout


def test_installation_lines_of_the_package_index_replace_those_of_a_clone(tmp_path):
    for name in ("README.md", "pyproject.toml", "serve/docs/getting_started.md"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    version = re.search(r'^version = "(.*)"', (ROOT / "pyproject.toml").read_text("utf-8"), re.MULTILINE)[1]
    for tag, code in (("v0.0.1", 1), (f"v{version}", 0), (f"v{version}", 0)):
        words = [sys.executable, ROOT / ".ci/published_lines.py", tag]
        assert finished(words, cwd=tmp_path).returncode == code
    page = (tmp_path / "serve/docs/getting_started.md").read_text("utf-8")
    assert re.findall(r"^pip install (\S+)", page, re.MULTILINE) == [
        "isocharge",
        "'isocharge[http]'",
        "'isocharge[simulate,http]'",
        "'torch>=2.9,<2.14'",
        "'isocharge[train]'",
    ]
    assert "pip install isocharge  " in (tmp_path / "README.md").read_text("utf-8")
    assert "not yet" not in page
