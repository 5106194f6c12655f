"""Recognition of frames of fixed length and of lines of text, without a description of the board.

The frames of random boards are encoded by struct, crcmod and cobs. A recognised description is correct if it gives the
charges of the board.
"""

import struct
from pathlib import Path

import crcmod.predefined
import numpy as np
import pytest
from cobs import cobs

from isocharge.serve import device_from_table
from isocharge.serve.recognition.recognise import described_frames_section, recognise

FRAMES = 300
RATE_HZ = 200.0
TYPES = ("i16", "u16", "i24", "u24", "i32", "f32", "f32 of counts", "f64 of counts")
SYNCS = ("AA 55", "A5 5A", "EB 90", "7E", "FF FE", "24 50 5A")
HEAD_FIELDS = ("seq8", "seq16", "seq32", "t16", "t32ms", "t32us", "status", "kind")
CRCS = {name: crcmod.predefined.Crc(name) for name in ("crc-8-maxim", "modbus", "x-25", "crc-ccitt-false", "crc-32")}
CHECKS = ("none", "sum-8", "negative", "xor", "sum-16", *CRCS)


def number(value, kind, order):
    """Return the bytes of a value as a number of a type. Integers wrap."""
    if kind[0] == "f":
        byte_order = "<" if order == "little" else ">"
        float_type = "f" if kind.startswith("f32") else "d"
        return struct.pack(byte_order + float_type, value)
    size = int(kind[1:]) // 8
    return (int(value) % (1 << 8 * size)).to_bytes(size, order)


def check_of(name, data, order):
    """Return the bytes of a checksum."""
    if name in CRCS:
        crc = CRCS[name].new(data)
        return crc.crcValue.to_bytes(crc.digest_size, order)
    if name == "xor":
        return bytes([int(np.bitwise_xor.reduce(np.frombuffer(data, np.uint8)))])
    value = {"none": 0, "sum-8": sum(data), "negative": -sum(data), "sum-16": sum(data)}[name]
    size = {"none": 0, "sum-16": 2}.get(name, 1)
    return (value % (1 << 8 * size)).to_bytes(size, order)


class RandomBoard:
    """A board with a random format.

    Attributes:
        values: Values of the channels in each frame, shape (FRAMES, electrodes).
        data: Bytes of the frames. The first bytes of the first frame may be missing.
    """

    def __init__(self, seed):
        rng = np.random.default_rng(seed)

        def pick(options):
            return options[rng.integers(len(options))]

        self.order = pick(("little", "big"))
        self.kind = pick(TYPES)
        self.electrodes = int(rng.integers(3, 5))
        self.sync = bytes.fromhex(pick(SYNCS))
        self.check = pick(CHECKS)
        self.framing = pick(("sync", "sync", "cobs"))
        head = [pick(HEAD_FIELDS) for _ in range(int(rng.integers(0, 3)))]
        # A frame has at most one counter and one clock.
        self.head = list({name[:1] if name[0] == "t" else name[:3]: name for name in head}.values())
        self.skips_sync = bool(rng.integers(2))
        self.end = pick((b"", b"", b"\r\n"))
        self.check_order = pick((self.order, "little"))

        bits = 0 if self.kind[0] == "f" else int(self.kind[1:])
        is_count = self.kind != "f32"
        max_log_noise = {0: 2.5, 16: 2.0}.get(bits, 3.8)
        noise = 10 ** rng.uniform(0.8, max_log_noise) if is_count else rng.uniform(0.1, 1.0)
        zero = 1 << (bits - 1) if self.kind[0] == "u" else 0
        rest = zero + rng.uniform(-40, 40, self.electrodes) * noise
        values = rest + rng.normal(0, noise, (FRAMES, self.electrodes))
        self.values = np.round(values) if is_count else values.astype(np.float32)

        self.first_seq = int(rng.integers(60_000))
        self.uptime_us = int(rng.integers(1 << 32))
        lost_bytes = int(rng.integers(9))
        self.data = b"".join(map(self.frame, range(FRAMES)))[lost_bytes:]

    def head_field(self, name, row):
        counts = {
            "seq8": (self.first_seq + row, "u8"),
            "seq16": (self.first_seq + row, "u16"),
            "seq32": (self.first_seq + row, "u32"),
            "t16": (self.first_seq + 5 * row, "u16"),
            "t32ms": (self.uptime_us // 1000 + 5 * row, "u32"),
            "t32us": (self.uptime_us + 5000 * row, "u32"),
            "status": (0, "u8"),
            "kind": (3, "u8"),
        }
        return number(*counts[name], self.order)

    def frame(self, row):
        body = b"".join(self.head_field(name, row) for name in self.head)
        body += b"".join(number(value, self.kind, self.order) for value in self.values[row])
        if self.framing == "cobs":
            return cobs.encode(body + check_of(self.check, body, self.check_order)) + b"\0"
        covered = body if self.skips_sync else self.sync + body
        return self.sync + body + check_of(self.check, covered, self.check_order) + self.end

    def is_read_by(self, table):
        """Return whether a description gives the values of the latest frames in adjacent channels."""
        parser = device_from_table({"frames": table}, "test").parser()
        parsed = np.array([frame.values for frame in parser.feed(self.data)])
        if len(parsed) < FRAMES - 3:
            return False
        for missing_at_end in (0, 1):
            sent = self.values[FRAMES - len(parsed) - missing_at_end : FRAMES - missing_at_end]
            for first in range(parsed.shape[1] - self.electrodes + 1):
                channels = parsed[:, first : first + self.electrodes]
                if len(sent) == len(parsed) and np.allclose(channels, sent, rtol=1e-6):
                    return True
        return False

    def has_number_and_clock_of(self, table):
        """Return whether a description contains the counter and the clock of the board."""
        names = {entry.get("name", "")[:2] for entry in table["fields"]}
        return all(("se" if name[0] == "s" else "t_") in names for name in self.head if name not in ("status", "kind"))


def test_frames_of_random_boards_are_recognised():
    """One board may be recognised wrongly, because constant bytes may belong to the numbers beside them or not."""
    wrong = []
    for seed in range(5000, 5012):
        board = RandomBoard(seed)
        table = recognise([board.data], FRAMES / RATE_HZ)
        if table is None or not board.is_read_by(table) or not board.has_number_and_clock_of(table):
            wrong.append((seed, vars(board) | {"values": None, "data": None}, table))
    assert len(wrong) <= 1, wrong


def test_frames_are_recognised_in_a_damaged_stream():
    """About 0.3 % of the bytes are wrong."""
    board = RandomBoard(3)
    rng = np.random.default_rng(0)
    stream = np.frombuffer(board.data, np.uint8).copy()
    is_damaged = rng.random(len(stream)) < 0.003
    stream[is_damaged] ^= rng.integers(1, 256, is_damaged.sum(), dtype=np.uint8)
    assert board.is_read_by(recognise([stream.tobytes()], FRAMES / RATE_HZ))


@pytest.mark.parametrize("seed", range(2))
def test_noise_is_not_recognised(seed):
    table = recognise([np.random.default_rng(seed).bytes(20_000)], 2.0)
    assert table is None


def test_constant_bytes_and_nothing_are_not_recognised():
    for data in (b"", b"\xaa" * 1000, b"\xaa\x55\x01\x02\x03\x04" * 100):
        assert described_frames_section([data], 1.0) is None


@pytest.mark.parametrize("tick_rate_Hz", [31250.0, 32768.0])
def test_clock_has_the_nearest_usual_tick_rate(tick_rate_Hz):
    ticks = np.round(np.arange(FRAMES) * tick_rate_Hz / RATE_HZ).astype(int)
    charges = np.random.default_rng(0).normal(800.0, 9.0, (FRAMES, 3)).round().astype(int)
    rows = zip(ticks.tolist(), charges.tolist(), strict=True)
    stream = b"".join(b"\xaa\x55" + struct.pack("<I3h", tick, *charge) for tick, charge in rows)
    section = described_frames_section([stream], FRAMES / RATE_HZ)
    clocks = [field for field in section["fields"] if field["name"] == "t_us"]
    assert [clock["scale"] for clock in clocks] == pytest.approx([1e6 / tick_rate_Hz])


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


@pytest.mark.parametrize("line", ["G1 X{:.1f}Y2Z3 ;layer", "no numbers {:.0f}x", "v1.2.{:.0f} <- ok"])
def test_printable_bytes_are_never_a_binary_format(line):
    rng = np.random.default_rng(0)
    data = "".join(line.format(value) + "\r\n" for value in rng.normal(500, 100, 400)).encode()
    assert (recognise([data], 1.0) or {"format": "text"})["format"] == "text"
