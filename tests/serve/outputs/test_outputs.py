"""Outputs of records: CSV, which is read by the csv module, and datagrams, which may have no receiver."""

import csv
import io
import json
import socket
import threading
import time
from contextlib import closing

import pytest

from isocharge.common.errors import InputError
from isocharge.serve.outputs.output import WriterQueue
from isocharge.serve.outputs.udp import UdpOutput
from isocharge.serve.record.formats import csv_header, csv_row
from isocharge.serve.record.record import FollowedFilm, TrackedContact

ELECTRODES = ("A", "B")


def test_csv_has_the_fields_of_a_record(contract, record):
    columns = [field for field in contract for _ in (ELECTRODES if field.endswith("_pC") else "_")]
    assert [name.partition(".")[0] for name in csv_header(ELECTRODES).split(",")] == columns
    written = record(tare_pC={"A": 1.0, "B": -2.5}, seq=7, flags=("gap", "outside"))
    assert csv_row(written, ELECTRODES) == (
        "1763600000.123457,,7,1.234568,,,,,,,,,,true,800.062500,,,,1.000000,-2.500000,gap outside,,linear/1,linear-film"
    )


@pytest.mark.parametrize("name", ["mine, left hand", 'the "good" one', "two\nlines", "cr\rlf", " blank "])
def test_csv_quotes_electrode_names(name, record):
    """Electrodes and films may have any names."""
    electrodes = ("A", name)
    row = csv_row(record(frame_id=name, charge_pC={"A": 1.0, name: 2.0}), electrodes)
    text = io.StringIO(f"{csv_header(electrodes)}\n{row}\n", newline="")
    (read,) = csv.DictReader(text, strict=True)
    assert (read["frame_id"], read[f"charge_pC.{name}"], read["model"]) == (name, "2.000000", "linear/1")
    assert None not in read


def test_tracked_contact_and_followed_film_are_the_last_columns(record):
    sections = ("track", "follow")
    header = csv_header(ELECTRODES, sections)
    assert header.removeprefix(csv_header(ELECTRODES)).startswith(",tracked.x_mm,tracked.y_mm,")
    options = {"sections": sections, "film": FollowedFilm(0.7, 0.05, 12)}
    touched = record(tracked=TrackedContact(*map(float, range(9))), event="tap", **options)
    lines = [csv_row(each, ELECTRODES) for each in (touched, record(**options))]
    names = ("tracked.x_mm", "tracked.vy_mm_s", "tracked.moving", "event", "film.pretension_MPa", "film.touches")
    rows = csv.DictReader([header, *lines], strict=True)
    assert [[row[name] for name in names] for row in rows] == [
        ["0.000000", "7.000000", "8.000000", "tap", "0.700000", "12"],
        ["", "", "", "", "0.700000", "12"],
    ]


def test_close_waits_for_a_slow_consumer():
    """The consumer needs more time for all lines than it may need for one line."""
    written = []

    def write_slowly(line):
        time.sleep(0.4)
        written.append(line)

    with closing(WriterQueue(write_slowly)) as queue:
        for line in "abcd":
            queue.put(line)
    assert ("".join(written), queue.lost) == ("abcd", 0)


def test_closed_queue_writes_no_further_item_when_the_consumer_continues(monkeypatch):
    """All three items count as lost, because it is not known whether the consumer takes the first item."""
    monkeypatch.setattr("isocharge.serve.outputs.output.CLOSE_TIMEOUT_s", 0.05)
    written = []
    continues = threading.Event()

    def write(line):
        continues.wait(20)
        written.append(line)

    queue = WriterQueue(write)
    for line in "abc":
        queue.put(line)
    queue.close()
    assert (queue.is_stuck, queue.lost) == (True, 3)
    continues.set()
    queue._thread.join(20)
    assert written == ["a"]


def test_datagrams_without_a_receiver_are_dropped(record):
    """The system reports a refused datagram as an error of the next datagram, which is dropped."""
    with socket.socket(type=socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        output = UdpOutput(f"udp://127.0.0.1:{receiver.getsockname()[1]}")
        output.write(record(seq=7))
        assert json.loads(receiver.recv(10_000))["seq"] == 7
    with closing(output):
        for _ in range(3):
            output.write(record())


@pytest.mark.parametrize(
    "address", ["127.0.0.1", "127.0.0.1:x", "127.0.0.1:70000", "no.such.host.invalid:1", f"{'a' * 70}.com:9", ""]
)
def test_datagrams_need_an_address(address):
    with pytest.raises(InputError, match=r"expected udp://HOST:PORT, as in udp://127"):
        UdpOutput(f"udp://{address}")
