"""The site: lists of attributes, the page of the commands, and the issue forms."""

import sys

import pytest
import yaml
from sphinx.ext.napoleon import Config, GoogleDocstring

from cli.test_help import COMMANDS
from kept import ROOT

DOCSTRING = """A contact.

Attributes:
    x_mm, y_mm: Position, mm. The text continues
        on another line.
    force_N: Force, N: positive if the probe pushes.

The end.
"""

FORMS = sorted((ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml"))


@pytest.fixture
def site(monkeypatch):
    """Import a module of the site by its name."""
    monkeypatch.syspath_prepend(ROOT / ".ci/docs")
    yield __import__
    for name in ("reference", "commands"):
        sys.modules.pop(name, None)


def test_several_attributes_with_one_description_are_listed_by_their_names(site):
    lines = str(GoogleDocstring(DOCSTRING, Config(napoleon_use_ivar=True))).splitlines()
    lines.insert(3, ":vartype x_mm: float")
    site("reference").list_attributes(None, "class", "Contact", None, None, lines)
    text = "\n".join(lines)
    assert text.count(":Attributes:") == 1
    assert "* **x_mm, y_mm**: Position, mm. The text continues\n      on another line.\n" in text
    assert "* **force_N**: Force, N: positive if the probe pushes." in text
    assert "ivar" not in text
    assert "vartype" not in text
    assert "The end." in lines


def test_the_page_of_the_commands_contains_every_command_with_its_options(site, tmp_path):
    path = tmp_path / "commands.md"
    site("commands").write_page(path)
    text = path.read_text("utf-8")
    for name, command in COMMANDS.items():
        section = text.partition(f"\n## isocharge {name}\n")[2].partition("\n## ")[0]
        assert f"Usage: isocharge {name} " in section
        assert all(option in section for parameter in command.params for option in parameter.opts if "--" in option)


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_an_issue_form_has_what_github_requires(path):
    form = yaml.safe_load(path.read_text("utf-8"))
    if path.stem == "config":
        assert form == {"blank_issues_enabled": True}
        return
    assert {"name", "description", "body"} <= form.keys()
    identifiers = [element["id"] for element in form["body"]]
    assert len(set(identifiers)) == len(identifiers)
    assert all(element["type"] in ("input", "textarea") and element["attributes"]["label"] for element in form["body"])
