"""Recognition of frames of fixed length and of lines of text, without a description of the board.

A recognised description of a random board is correct if it gives the charges of the board.
"""

import struct
from pathlib import Path

import numpy as np
import pytest
from cobs import cobs

from isocharge.serve import Frame, device_from_table
from isocharge.serve.frames.transmission import CHECKSUMS
from isocharge.serve.recognition.framing import find_checks
from isocharge.serve.recognition.recognise import described_frames_section, recognise
from layout_encoder import encode_layout

FRAMES = 300
RATE_HZ = 200.0
TYPES = ("i16", "u16", "i24", "u24", "i32", "f32", "f32 of counts", "f64 of counts")
SYNCS = ("AA 55", "A5 5A", "EB 90", "7E", "FF FE", "24 50 5A")
HEAD_FIELDS = (
    *({"name": "seq", "type": type_name} for type_name in ("u8", "u16", "u32")),
    *({"name": "t_ms", "type": type_name} for type_name in ("u16", "u32")),
    {"name": "t_us", "type": "u32"},
    *({"type": "pad", "value": value} for value in ("00", "03")),
)
CRCS = ("crc-8/maxim", "crc-16/modbus", "crc-16/x-25", "crc-16/ccitt-false", "crc-32")
CHECKS = ("none", "sum-8", "sum-8/negative", "xor-8", "sum-16", *CRCS)


class RandomBoard:
    """A board with a random format.

    Attributes:
        table: Section `[frames]` that describes the format.
        values: Values of the channels in each frame, shape (FRAMES, electrodes).
        data: Bytes of the frames. The first bytes of the first frame may be missing.
    """

    def __init__(self, seed):
        rng = np.random.default_rng(seed)

        def pick(options):
            return options[rng.integers(len(options))]

        order = pick(("little", "big"))
        kind = pick(TYPES)
        electrodes = int(rng.integers(3, 5))
        sync = pick(SYNCS)
        checksum = pick(CHECKS)
        is_stuffed = pick((False, False, True))
        head = [pick(HEAD_FIELDS) for _ in range(int(rng.integers(0, 3)))]
        # A frame has at most one counter and one clock.
        self.head = list({field.get("name", field.get("value"))[:2]: field for field in head}.values())
        skips_sync = bool(rng.integers(2))
        end = pick((b"", b"", b"\r\n"))
        type_name = kind.split()[0]
        fields = self.head + [{"name": name, "type": type_name} for name in "ABCD"[:electrodes]]
        sizes = [int(field.get("type", "pad8").strip("iufpad") or 8) // 8 for field in fields]
        sync_size = 0 if is_stuffed else len(bytes.fromhex(sync))
        self.table = {
            "format": "described",
            "byte_order": order,
            "checksum": checksum,
            "fields": fields,
            "checksum_order": pick((order, "little")),
            "length": sync_size + sum(sizes) + CHECKSUMS[checksum].size,
            "checksum_from": sync_size if skips_sync else 0,
        }
        self.table |= {"framing": "cobs"} if is_stuffed else {"sync": sync}

        bits = 0 if kind[0] == "f" else int(kind[1:])
        is_count = kind != "f32"
        max_log_noise = {0: 2.5, 16: 2.0}.get(bits, 3.8)
        noise = 10 ** rng.uniform(0.8, max_log_noise) if is_count else rng.uniform(0.1, 1.0)
        zero = 1 << (bits - 1) if kind[0] == "u" else 0
        rest = zero + rng.uniform(-40, 40, electrodes) * noise
        values = rest + rng.normal(0, noise, (FRAMES, electrodes))
        self.values = np.round(values) if is_count else values.astype(np.float32)

        layout = device_from_table({"frames": self.table}, "board").frames
        first_seq, uptime_us, lost_bytes = (int(rng.integers(limit)) for limit in (60_000, 1 << 32, 9))
        frames = [
            encode_layout(layout, Frame(first_seq + row, uptime_us + 5000 * row, tuple(numbers)))
            for row, numbers in enumerate(self.values.tolist())
        ]
        self.data = b"".join(cobs.encode(data) + b"\0" if is_stuffed else data + end for data in frames)[lost_bytes:]

    def is_read_by(self, table):
        """Return whether a description gives the values of the latest frames in adjacent channels."""
        parser = device_from_table({"frames": table}, "test").parser()
        parsed = np.array([frame.values for frame in parser.feed(self.data)])
        if len(parsed) < FRAMES - 3:
            return False
        electrodes = self.values.shape[1]
        for missing_at_end in (0, 1):
            sent = self.values[FRAMES - len(parsed) - missing_at_end : FRAMES - missing_at_end]
            for first in range(parsed.shape[1] - electrodes + 1):
                channels = parsed[:, first : first + electrodes]
                if len(sent) == len(parsed) and np.allclose(channels, sent, rtol=1e-6):
                    return True
        return False

    def has_number_and_clock_of(self, table):
        """Return whether a description contains the counter and the clock of the board."""
        names = {entry.get("name", "")[:2] for entry in table["fields"]}
        return {field["name"][:2] for field in self.head if "name" in field} <= names


def test_frames_of_random_boards_are_recognised():
    """One board may be recognised wrongly, because constant bytes may belong to the numbers beside them or not."""
    wrong = []
    for seed in range(5000, 5012):
        board = RandomBoard(seed)
        table = recognise([board.data], FRAMES / RATE_HZ)
        if table is None or not board.is_read_by(table) or not board.has_number_and_clock_of(table):
            wrong.append((seed, board.table, table))
    assert len(wrong) <= 1, wrong


def test_frames_are_recognised_in_a_damaged_stream():
    """About 0.3 % of the bytes are wrong."""
    board = RandomBoard(3)
    rng = np.random.default_rng(0)
    stream = np.frombuffer(board.data, np.uint8).copy()
    is_damaged = rng.random(len(stream)) < 0.003
    stream[is_damaged] ^= rng.integers(1, 256, is_damaged.sum(), dtype=np.uint8)
    assert board.is_read_by(recognise([stream.tobytes()], FRAMES / RATE_HZ))


def recognised_fields(number_formats, head, values):
    """Return the recognised fields of frames that begin with AA 55, followed by a number and the values of channels."""
    rows = np.column_stack([head, values]).astype(int).tolist()
    data = b"".join(b"\xaa\x55" + struct.pack(number_formats, *numbers) for numbers in rows)
    return recognise([data], FRAMES / RATE_HZ)["fields"]


VALUES = np.random.default_rng(0).normal(0.0, 300.0, (FRAMES, 4)).round()
"""Values of four channels, shape (FRAMES, 4)."""


@pytest.mark.parametrize(("channel", "constant"), [(1, 0), (1, -7), (3, 0)])
def test_channel_that_never_changes_is_kept_beside_the_others(channel, constant):
    """The doctor can only report a dead channel that the description contains."""
    values = VALUES.copy()
    values[:, channel] = constant
    fields = recognised_fields("<H4h", np.arange(FRAMES), values)
    assert [field["name"] for field in fields] == ["seq", "ch1", "ch2", "ch3", "ch4"]


def test_checksum_covers_at_least_two_bytes():
    """Every byte would be its own sum of 16 bits."""
    value = np.arange(100, dtype=np.uint8)
    alone = np.column_stack([value, value, np.zeros_like(value)])
    assert list(find_checks(alone)) == []
    pair = np.column_stack([value, 2 * value, 3 * value.astype(np.uint16) % 256, 3 * value.astype(np.uint16) // 256])
    assert next(find_checks(pair.astype(np.uint8))).name == "sum-16"


@pytest.mark.parametrize("seed", range(2))
def test_noise_is_not_recognised(seed):
    table = recognise([np.random.default_rng(seed).bytes(20_000)], 2.0)
    assert table is None


def test_constant_bytes_and_nothing_are_not_recognised():
    for data in (b"", b"\xaa" * 1000, b"\xaa\x55\x01\x02\x03\x04" * 100):
        assert described_frames_section([data], 1.0) is None


@pytest.mark.parametrize("tick_rate_Hz", [31250.0, 32768.0])
def test_clock_has_the_nearest_usual_tick_rate(tick_rate_Hz):
    ticks = np.round(np.arange(FRAMES) * tick_rate_Hz / RATE_HZ)
    clock, *_ = recognised_fields("<I4h", ticks, VALUES)
    assert (clock["name"], clock["scale"]) == ("t_us", pytest.approx(1e6 / tick_rate_Hz))


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        (lambda k, q: f"{k},{2 * k},{q}", {"columns": ["seq", "t_ms", "ch1"]}),
        (lambda k, q: f"{(5 * k) % 65536};{q};7", {}),
        (lambda k, q: f'{{"i": {k}, "at": {1.7e9 + k / 500:.4f}, "x": {q}}}', {"seq": "i", "t_s": "at"}),
        (lambda k, q: f"micros:{2000 * k},q:{q}", {"t_us": "micros"}),
        (lambda _, q: f"A:{q},B:{q + 0.5}", {}),
    ],
)
def test_counter_and_clock_columns_in_text_are_recognised(lines, expected):
    """The board sends 500 lines per second. A column that increases with no usual unit is a channel."""
    rng = np.random.default_rng(0)
    rows = [lines(number, round(rng.normal(5.0, 0.3), 3)) for number in range(400)]
    text = "\n".join(["", *rows, ""])
    assert recognise([text.encode()], 0.8) == {"format": "text"} | expected


def test_header_of_a_csv_stream_becomes_part_of_the_device_file():
    """A board sends the header only once. A program that starts later reads the columns by the device file."""
    rng = np.random.default_rng(0)
    lines = [f"{k},{2 * k},{rng.normal(5.0, 0.3):.3f},{rng.normal(5.0, 0.3):.3f}" for k in range(400)]
    text = "\n".join(["n,millis,north,south", *lines]) + "\n"
    table = recognise([text.encode()], 0.8)
    assert table == {"format": "text", "columns": ["seq", "t_ms", "north", "south"]}
    parser = device_from_table({"frames": table, "channels": {"A": "south"}}, "test").parser()
    (*_, last) = parser.feed("\n".join(["", *lines[200:], ""]).encode())
    assert (last.seq, last.t_us, last.names) == (399, 798_000, ("north", "south"))


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parents[2] / "data" / "serial_text").glob("*.txt")), ids=lambda path: path.stem
)
def test_notations_of_public_firmware_are_text(path):
    """At rest, the electrodes A, B and C have 3, -2 and 5 pC, with a noise of 1 pC."""
    data = path.read_bytes()
    table = recognise([data], 0.3)
    assert table["format"] == "text"
    frames = device_from_table({"frames": table}, "test").parser().feed(data)
    assert len(frames) >= 58
    values = np.array([frame.values for frame in frames])
    np.testing.assert_allclose(values.mean(axis=0)[-3:], [3.0, -2.0, 5.0], atol=0.5)
    assert values.shape[1] == 3


@pytest.mark.parametrize(
    "line", ["G1 X{:.1f}Y2Z3 ;layer", "no numbers {:.0f}x", "v1.2.{:.0f} <- ok", "1.5,{:.0f}\x1f2.5,3.5,4.5"]
)
def test_printable_bytes_are_never_a_binary_format(line):
    rng = np.random.default_rng(0)
    data = "".join(line.format(value) + "\r\n" for value in rng.normal(500, 100, 400)).encode()
    assert (recognise([data], 1.0) or {"format": "text"})["format"] == "text"


def test_counter_of_one_byte_that_restarts_is_recognised():
    counter, *_ = recognised_fields("<B4h", np.arange(FRAMES) % 256, VALUES)
    assert (counter["name"], counter["type"]) == ("seq", "u8")
