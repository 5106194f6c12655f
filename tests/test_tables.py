"""Tables: every reader takes what it says, refuses the rest, and names file, key and value."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from isocharge.common.errors import DeviceError, SensorError
from isocharge.common.tables import LONGEST_VALUE, Table, is_number, is_whole, parse_toml, read_toml, shown

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


def table(**values):
    return Table({"film": values}, "mine.toml", SensorError).table("film")


@given(JSON)
def test_each_reader_gives_its_own_type_or_names_the_key(value):
    kinds = {
        "number": float,
        "whole": int,
        "flag": bool,
        "text": str,
        "sequence": list,
        "texts": tuple,
        "table": Table,
    }
    for reader, kind in kinds.items():
        try:
            result = getattr(table(key=value), reader)("key")
        except SensorError as error:
            message = str(error)
        else:
            assert type(result) is kind
            continue
        assert message.startswith("mine.toml: film.key: expected ")


@given(JSON)
def test_numbers_are_finite_and_no_bools(value):
    good = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    assert is_number(value) == good
    assert is_whole(value) == (good and isinstance(value, int))


@pytest.mark.parametrize(
    ("bounds", "good", "wrong", "expected"),
    [
        ({"above": 0.0}, 1e-9, 0.0, "a positive number"),
        ({"least": 0}, 0, -1e-9, "a number from 0"),
        ({"least": 1, "most": 5}, 5, 5.1, "a number from 1 to 5"),
        ({"most": 5}, 5, 6, "a number of at most 5"),
        ({"above": 0.0, "most": 1}, 1, 0, "a number above 0 and at most 1"),
        ({}, -1e300, 10**400, "a finite number"),
        ({"above": 0.0, "or_infinite": True}, math.inf, -math.inf, "a positive number or inf"),
        ({"not_zero": True}, -1e-9, 0, "a finite number that is not 0"),
    ],
)
def test_bounds_of_numbers(bounds, good, wrong, expected):
    assert table(key=good).number("key", **bounds) == good
    with pytest.raises(SensorError, match=rf"^mine\.toml: film\.key: expected {expected}, got "):
        table(key=wrong).number("key", **bounds)


def test_bounds_of_whole_numbers():
    assert table(key=3).whole("key", least=3, most=3) == 3
    with pytest.raises(SensorError, match="expected a whole number from 0 to 1000000, got 1000001"):
        table(key=1_000_001).whole("key", least=0, most=1_000_000)
    with pytest.raises(SensorError, match=r"expected a whole number, got 3\.0"):
        table(key=3.0).whole("key")


def test_keys_that_are_absent():
    assert table().number("key", 2.5) == 2.5
    with pytest.raises(SensorError, match=r"^mine\.toml: key 'film\.key' is missing$"):
        table().number("key")


def test_keys_that_are_unknown():
    assert "a" in table(a=1).only("a", "b")
    assert list(table(a=1, b=2)) == ["a", "b"]
    with pytest.raises(SensorError, match=r"^mine\.toml: unknown key 'film\.c'; known are a, b$"):
        table(a=1, c=2).only("a", "b")


def test_choices_and_lists():
    assert table(key="b").choice("key", ("a", "b")) == "b"
    with pytest.raises(SensorError, match=r"expected one of a, b, got \['a'\]"):
        table(key=["a"]).choice("key", ("a", "b"))
    assert table(key=[1, 2.5]).numbers("key", count=2, of="[x, y] in mm") == (1.0, 2.5)
    with pytest.raises(SensorError, match=r"expected \[x, y\] in mm, got \[1, True\]"):
        table(key=[1, True]).numbers("key", count=2, of="[x, y] in mm")


def test_texts_may_be_empty_where_that_has_a_meaning():
    assert table(key="").text("key", or_empty=True) == ""
    assert table(key=["", "a"]).texts("key", or_empty=True) == ("", "a")
    with pytest.raises(SensorError, match=r"expected a list of names, got \['', 'a'\]"):
        table(key=["", "a"]).texts("key", of="names")


def test_tables_of_a_list_are_numbered():
    first, second = table(key=[{"a": 1}, {"a": "x"}]).tables("key")
    assert first.number("a") == 1.0
    with pytest.raises(SensorError, match=r"^mine\.toml: film\.key\[2\]\.a: expected a finite number, got 'x'$"):
        second.number("a")
    with pytest.raises(SensorError, match=r"^mine\.toml: film\.key\[1\]: expected a table, got 3$"):
        table(key=[3]).tables("key")
    with pytest.raises(SensorError, match=r"^mine\.toml: film\.key: expected a list of tables, got 3$"):
        table(key=3).tables("key")


def test_without_a_file_a_message_begins_with_the_key():
    with pytest.raises(SensorError, match=r"^expected a table, got 3$"):
        Table(3, "", SensorError)
    with pytest.raises(SensorError, match=r"^key 'a' is missing$"):
        Table({}, "", SensorError).get("a")


def test_messages_stay_short():
    """A value of a megabyte, a list nested too deeply to print, and a number with too many digits are cut."""
    nested = []
    for _ in range(100_000):
        nested = [nested]
    for value in ("x" * 1_000_000, nested, 10**10_000):
        with pytest.raises(SensorError) as caught:
            table(key=value).number("key")
        assert len(str(caught.value)) < LONGEST_VALUE + 100
    with pytest.raises(SensorError) as caught:
        table(**{f"key{i}": i for i in range(10_000)}).only(*map(str, range(10_000)))
    assert len(str(caught.value)) < 2 * LONGEST_VALUE + 100
    assert shown(3.0) == "3.0"


def test_toml_files(tmp_path):
    path = tmp_path / "board.toml"
    path.write_text("a = 1")
    assert read_toml(path, "a device file", DeviceError) == {"a": 1}
    path.write_text("a = x")
    with pytest.raises(DeviceError, match=rf"^{path}: not a TOML file: .*line 1"):
        read_toml(path, "a device file", DeviceError)
    path.write_bytes(b"\xff")
    with pytest.raises(DeviceError, match=rf"^{path}: not a TOML file: not text in UTF-8"):
        read_toml(path, "a device file", DeviceError)
    with pytest.raises(DeviceError, match=r"cannot be read \(.*\); expected a device file in TOML"):
        read_toml(tmp_path, "a device file", DeviceError)
    with pytest.raises(DeviceError, match="not a TOML file"):
        parse_toml("a = " + "[" * 100_000, "deep.toml", DeviceError)
