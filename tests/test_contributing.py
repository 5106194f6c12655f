"""The recipes of CONTRIBUTING.md work. Each recipe is followed completely in a copy of the project."""

import os
import re
import shutil
import sys
from pathlib import Path

import pytest

from kept import ROOT

TEXT = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
RECIPES = dict(re.findall(r"^## (Add .*?)\n(.*?)(?=^## |\Z)", TEXT, re.DOTALL | re.MULTILINE))


@pytest.fixture
def project(tmp_path):
    """A copy of the project."""
    for name in ("simulate", "train", "serve", "tests", "models", "pyproject.toml"):
        source, target = ROOT / name, tmp_path / name
        if source.is_dir():
            shutil.copytree(source, target, ignore=shutil.ignore_patterns("__pycache__", "pictures"))
        else:
            shutil.copy(source, target)
    return tmp_path


def blocks(recipe, language):
    """Return the file and the text of each block of a language. The first line of a block names the file."""
    return re.findall(rf"^```{language}\n# (\S+)\n(.*?)^```", recipe, re.DOTALL | re.MULTILINE)


def hunks(lines):
    """Return pairs (old text, new text) of the changes of a diff.

    A change begins with lines that are in the file, and ends with its added lines.
    """
    old, new = [], []
    for line in lines:
        is_added = line.startswith("+")
        has_added_lines = any(new_line not in old for new_line in new)
        if has_added_lines and not is_added:
            yield "\n".join(old), "\n".join(new)
            old, new = [], []
        if not is_added:
            old.append(line[1:])
        if not line.startswith("-"):
            new.append(line[1:])
    yield "\n".join(old), "\n".join(new)


def follow(recipe, project):
    """Follow a recipe in a copy of the project: write its new files, and apply its diffs to the other files."""
    for name, text in blocks(recipe, "python"):
        assert not (project / name).exists(), name
        (project / name).write_text(text, "utf-8")
    for name, text in blocks(recipe, "diff"):
        content = (project / name).read_text("utf-8")
        for old, new in hunks(text.splitlines()):
            assert f"\n{content}".count(f"\n{old}\n") == 1, f"{name} has not this once:\n{old}"
            content = f"\n{content}".replace(f"\n{old}\n", f"\n{new}\n")[1:]
        (project / name).write_text(content, "utf-8")


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_fits_the_project(name, project):
    follow(RECIPES[name], project)


@pytest.mark.slow
@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_works(name, project, run_commands):
    """On a copy of the project: its packages come first, then this environment's."""
    follow(RECIPES[name], project)
    (commands,) = re.findall(r"^```sh\n(.*?)^```", RECIPES[name], re.DOTALL | re.MULTILINE)
    found = {
        "PYTHONPATH": ":".join(str(project / name) for name in ("simulate", "train", "serve")),
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
    }
    printed = run_commands(commands, project, os.environ | found)
    assert int(re.search(r"(\d+) passed", printed)[1]) > 0
