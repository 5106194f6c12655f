"""Reading of files, of lines and of the parts of interrupted runs. The memory is bounded for any content."""

import io
import os
import signal
from pathlib import Path

import pytest

from isocharge.common.errors import OutputError, OutputExists
from isocharge.common.files import AtomicWriter, bounded_lines, new_file, new_folder, read_whole


def test_a_file_is_read_whole(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"12345")
    assert read_whole(path) == read_whole(path, 5) == b"12345"
    with pytest.raises(OSError, match="larger than 4 bytes"):
        read_whole(path, 4)


@pytest.mark.timeout(20)
def test_what_is_no_file_is_not_read(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", tmp_path, Path("/dev/zero")):
        with pytest.raises(OSError, match="not a regular file"):
            read_whole(path)


def test_nothing_of_an_interrupted_write_stays(tmp_path, monkeypatch):
    """Ctrl-C interrupts the function immediately after the bytes are written."""
    file, write = AtomicWriter(tmp_path / "file"), os.write
    monkeypatch.setattr("os.write", lambda *words: write(*words) and signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        file.write(b"long enough")
    monkeypatch.undo()
    file.write(b"short")
    file.close()
    assert (tmp_path / "file").read_bytes() == b"short"


def fill(path, text, then=lambda: None):
    with new_file(path) as draft:
        draft.write_text(text)
        then()


def test_a_new_file_is_there_whole_or_not_at_all(tmp_path):
    path, other = tmp_path / "file", tmp_path / "other"
    fill(path, "whole", lambda: not path.exists() or pytest.fail("it has its name too early"))
    with pytest.raises(OutputExists, match="already there"):
        fill(path, "late")
    with pytest.raises(KeyboardInterrupt):
        fill(other, "half", lambda: signal.raise_signal(signal.SIGINT))
    with pytest.raises(OutputExists, match="already there"):
        fill(other, "late", lambda: other.write_text("faster"))
    with pytest.raises(OutputError, match="third cannot be written"):
        fill(tmp_path / "third", "half", lambda: (tmp_path / "no" / "file").touch())
    with pytest.raises(OutputError, match="File name too long"), new_folder(tmp_path / ("a" * 300) / "folder"):
        pass
    assert {each.name: each.read_text() for each in tmp_path.iterdir()} == {"file": "whole", "other": "faster"}


def test_lines_are_bounded():
    assert list(bounded_lines(io.StringIO("a\nbc\nd"), 3)) == ["a\n", "bc\n", "d"]
    with pytest.raises(ValueError, match="longer than 2 characters"):
        list(bounded_lines(io.StringIO("a\nbc\n"), 2))
