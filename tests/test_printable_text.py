"""Text for terminals: no escape sequence, bidi mark or zero-width character of a name reaches the terminal."""

import json
import re
import unicodedata

import pytest
from hypothesis import given
from hypothesis import strategies as st

from isocharge.common.errors import InputError, OutputError, cut, is_printable, printable, printable_lines, shown
from isocharge.common.toml_text import to_toml
from kept import ROOT

FOREIGN = [
    ("A\x1b[2J", r"A\u001b[2J"),  # escape sequence
    ("\aA\r\x7f", r"\u0007A\r\u007f"),  # bell, return, delete
    ("\x9b31m", r"\u009b31m"),  # C1 control
    ("A\u202eB", r"A\u202eB"),  # right-to-left override
    ("\u2066A\u2069", r"\u2066A\u2069"),  # bidi isolate
    ("A\u200b\u200d\ufeff", r"A\u200b\u200d\ufeff"),  # zero-width
    ("\u3164A\u115f", r"\u3164A\u115f"),  # invisible letter
    ("A\ufe0f\U000e0101", r"A\ufe0f\udb40\udd01"),  # variation selector
    ("A\u2028B\nC", r"A\u2028B\nC"),  # line separator
    ("A\udc1b", r"A\udc1b"),  # lone surrogate
    ("\U000e0041", r"\udb40\udc41"),  # tag
]

HARMFUL_CATEGORIES = {"Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp"}


@pytest.mark.parametrize(("text", "escaped"), FOREIGN)
def test_foreign_characters_are_escaped(text, escaped):
    assert printable(text) == escaped
    assert not is_printable(text)


@pytest.mark.parametrize("text", ["", "A", "Kanal 3 (µV)", "Größe °C", "電極", "café", "a\\x1b"])
def test_ordinary_names_are_not_changed(text):
    assert printable(text) == text


@given(st.text())
def test_nothing_that_a_terminal_obeys_or_hides_is_left(text):
    """The characters are compared with the categories of Unicode. A JSON parser converts the escapes to the text."""
    for result in (printable(text), printable_lines(text).replace("\n", ""), cut(text), shown(text)):
        assert HARMFUL_CATEGORIES.isdisjoint(map(unicodedata.category, result))
    assert json.loads(printable(json.dumps(text, ensure_ascii=False))) == text


def test_lines_keep_their_line_feeds():
    assert printable_lines("two\nlines\x1b") == "two\nlines\\u001b"


@pytest.mark.parametrize("kind", [InputError, OutputError])
def test_messages_of_errors_are_printable(kind):
    assert str(kind("channel '\x1b]0;title\x07'")) == r"channel '\u001b]0;title\u0007'"


def test_comments_of_toml_files_are_printable():
    assert to_toml({}, ("channels \x1b[2J\u202e",)) == "# channels \\u001b[2J\\u202e\n\n"


def test_commands_print_only_through_the_module_that_escapes():
    """`isocharge.cli.shared.terminal` prints; records of `serve predict` are JSON in ASCII already."""
    allowed = {"serve/isocharge/cli/shared/terminal.py": None, "serve/isocharge/cli/serve/predict.py": 1}
    direct_output = re.compile(r"(?<![\w.])print\(|typer\.(?:echo|secho)\(|std(?:out|err)\.write\(")
    for stage in ("simulate", "train", "serve"):
        for path in sorted((ROOT / stage / "isocharge" / "cli").rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            found = direct_output.findall(path.read_text("utf-8"))
            limit = allowed.get(name, 0)
            assert limit is None or len(found) <= limit, name
