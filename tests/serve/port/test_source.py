"""Files, pipes and ports by one name."""

import os
import threading

import pytest

from isocharge.common.errors import InputError
from isocharge.serve import Port, open_source

pytestmark = pytest.mark.xdist_group("clock")


def test_file_is_read_to_its_end(tmp_path):
    path = tmp_path / "frames.bin"
    path.write_bytes(bytes(range(256)) * 40)
    with open_source(str(path)) as source:
        chunks = list(source)
    assert b"".join(chunk.data for chunk in chunks) == path.read_bytes()
    assert {chunk.outage_s for chunk in chunks} == {0.0}


def test_named_pipe_is_read_as_it_comes(tmp_path):
    path = tmp_path / "pipe"
    os.mkfifo(path)
    threading.Thread(target=path.write_bytes, args=(b"hello",)).start()
    with open_source(str(path)) as source:
        assert [chunk.data for chunk in source] == [b"hello"]


def test_source_is_stdin(monkeypatch):
    reader, writer = os.pipe()
    os.write(writer, b"hello")
    os.close(writer)
    with os.fdopen(reader) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        with open_source("-") as source:
            assert [chunk.data for chunk in source] == [b"hello"]


@pytest.mark.parametrize("url", ["/dev/ttyNone", "socket://127.0.0.1:1", "loop://"])
def test_source_of_any_other_name_is_a_port(url):
    assert isinstance(open_source(url, reconnect=True), Port)


def test_file_that_may_not_be_read(tmp_path, monkeypatch):
    path = tmp_path / "frames.bin"
    path.write_bytes(b"x")
    monkeypatch.setattr("pathlib.Path.open", lambda *_, **__: (_ for _ in ()).throw(PermissionError(13, "not yours")))
    with pytest.raises(InputError, match=r"frames.bin: cannot be read \(not yours\)"), open_source(str(path)):
        pass
