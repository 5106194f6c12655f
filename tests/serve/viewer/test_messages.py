"""What a page asks for: the known requests are read, anything else is refused with a reason."""

import json

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from isocharge.common.errors import RequestError
from isocharge.common.structs import parse_json
from isocharge.serve.viewer.messages import (
    LiveRequest,
    Marker,
    Record,
    ReplayRequest,
    Seek,
    Speed,
    Tare,
    confirmed_number,
)


def parse(text, kind=LiveRequest | ReplayRequest):
    return parse_json(text, "", RequestError, kind)


@pytest.mark.parametrize(
    ("text", "request_"),
    [
        ('{"do": "tare"}', Tare()),
        ('{"do": "record", "on": true}', Record(on=True)),
        ('{"do": "marker", "text": "here"}', Marker("here")),
        ('{"do": "seek", "value": 12.5}', Seek(12.5)),
        ('{"do": "speed", "value": 24}', Speed(24.0)),
    ],
)
def test_requests_are_read(text, request_):
    assert parse(text) == request_


@pytest.mark.parametrize(
    "content",
    [
        {"do": "shutdown"},
        {"do": "record"},
        {"do": "record", "on": 1},
        {"do": "marker", "text": "x" * 81},
        {"do": "marker", "text": "a\nb"},
        {"do": "seek", "value": -1},
        {"do": "seek", "value": 1e99},
        {"do": "speed", "value": 0},
        {"do": "tare", "path": "/etc/passwd"},
        [],
        "tare",
    ],
)
def test_other_requests_are_refused(content):
    with pytest.raises(RequestError):
        parse(json.dumps(content))


def test_a_live_page_does_not_seek():
    with pytest.raises(RequestError, match="one of tare, record, marker"):
        parse('{"do": "seek", "value": 1}', LiveRequest)


@given(st.text() | st.recursive(st.none() | st.text() | st.floats(), st.lists, max_leaves=5).map(json.dumps))
@example("[" * 5000)
@example('{"do": "seek", "value": NaN}')
@example('{"do": "seek", "value": 1' + "0" * 4000 + "}")
def test_no_text_breaks_it(text):
    with pytest.raises(RequestError):
        parse(text)


def test_confirmations_have_four_bytes():
    assert confirmed_number(b"\x01\x02\x00\x00") == 513
    with pytest.raises(RequestError, match="four bytes"):
        confirmed_number(b"\x01")
