"""Conversion of tables to TOML. The standard library reads the same tables from the text."""

import tomllib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from isocharge.common.toml_text import to_toml

TEXT = st.text(st.characters(codec="utf-8"), max_size=8)
SCALARS = TEXT | st.booleans() | st.integers(-(2**62), 2**62) | st.floats(allow_nan=False)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3), max_leaves=8
)


@given(tables=st.dictionaries(TEXT, VALUES, max_size=5), comment=st.lists(TEXT, max_size=3))
@settings(derandomize=True, max_examples=100)
def test_what_is_written_is_read(tables, comment):
    assert tomllib.loads(to_toml(tables, comment)) == tables


def test_sections_come_after_keys_and_comments_first():
    text = to_toml({"film": {"radius_mm": 45.0, "of": {"a": [1, [2.5]]}}, "name": "mine"}, ["first", "second"])
    assert text == '# first\n# second\n\nname = "mine"\n\n[film]\nradius_mm = 45.0\nof = {a = [1, [2.5]]}\n'


@pytest.mark.parametrize("value", [None, {1, 2}, object()])
def test_other_values_are_refused(value):
    with pytest.raises(TypeError, match="expected a text, a number, true or false, a list or a table, got"):
        to_toml({"key": [value]})
