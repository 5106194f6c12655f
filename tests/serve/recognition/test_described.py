"""Frames of fixed length that nobody has described: boards drawn at random, packed by struct, crcmod and cobs.

What is recognised is judged by the charges that come out of it, not by the words of the description.
"""

import struct

import crcmod.predefined
import numpy as np
import pytest
from cobs import cobs

from isocharge.serve import device_from_table
from isocharge.serve.recognition.recognise import described_frames, recognise

FRAMES, RATE_HZ = 300, 200.0
TYPES = ("i16", "u16", "i24", "u24", "i32", "f32", "f32 of counts", "f64 of counts")
SYNCS = ("AA 55", "A5 5A", "EB 90", "7E", "FF FE", "24 50 5A")
HEADS = ("seq8", "seq16", "seq32", "t16", "t32ms", "t32us", "status", "kind")
CYCLIC = {name: crcmod.predefined.Crc(name) for name in ("crc-8-maxim", "modbus", "x-25", "crc-ccitt-false", "crc-32")}
CHECKS = ("none", "sum-8", "negative", "xor", "sum-16", *CYCLIC)


def number(value, kind, order):
    """A value in the bytes of a type; integers wrap."""
    if kind[0] == "f":
        return struct.pack(("<" if order == "little" else ">") + {"3": "f", "6": "d"}[kind[1]], value)
    size = int(kind[1:]) // 8
    return (int(value) % (1 << 8 * size)).to_bytes(size, order)


def check_of(name, data, order):
    if name in CYCLIC:
        crc = CYCLIC[name].new(data)
        return crc.crcValue.to_bytes(crc.digest_size, order)
    if name == "xor":
        return bytes([int(np.bitwise_xor.reduce(np.frombuffer(data, np.uint8)))])
    value = {"none": 0, "sum-8": sum(data), "negative": -sum(data), "sum-16": sum(data)}[name]
    size = {"none": 0, "sum-16": 2}.get(name, 1)
    return (value % (1 << 8 * size)).to_bytes(size, order)


class RandomBoard:
    """A board: its bytes, and the values of its channels in each frame."""

    def __init__(self, seed):
        rng = np.random.default_rng(seed)
        pick = lambda options: options[rng.integers(len(options))]  # noqa: E731
        self.order, self.kind, self.electrodes = pick(("little", "big")), pick(TYPES), int(rng.integers(3, 5))
        self.sync, self.check, self.framing = bytes.fromhex(pick(SYNCS)), pick(CHECKS), pick(("sync", "sync", "cobs"))
        head = [pick(HEADS) for _ in range(int(rng.integers(0, 3)))]
        self.head = list({name[:1] if name[0] == "t" else name[:3]: name for name in head}.values())
        self.skips_sync, self.end = bool(rng.integers(2)), pick((b"", b"", b"\r\n"))
        self.check_order = pick((self.order, "little"))
        bits = 0 if self.kind[0] == "f" else int(self.kind[1:])
        is_count = self.kind != "f32"
        noise = 10 ** rng.uniform(0.8, {0: 2.5, 16: 2.0}.get(bits, 3.8)) if is_count else rng.uniform(0.1, 1.0)
        zero = 1 << (bits - 1) if self.kind[0] == "u" else 0
        self.values = (
            zero + rng.uniform(-40, 40, self.electrodes) * noise + rng.normal(0, noise, (FRAMES, self.electrodes))
        )
        self.values = np.round(self.values) if is_count else self.values.astype(np.float32)
        self.first, self.uptime = int(rng.integers(60_000)), int(rng.integers(1 << 32))
        self.data = b"".join(map(self.frame, range(FRAMES)))[int(rng.integers(9)) :]

    def word(self, name, k):
        counts = {
            "seq8": (self.first + k, "u8"),
            "seq16": (self.first + k, "u16"),
            "seq32": (self.first + k, "u32"),
            "t16": (self.first + 5 * k, "u16"),
            "t32ms": (self.uptime // 1000 + 5 * k, "u32"),
            "t32us": (self.uptime + 5000 * k, "u32"),
            "status": (0, "u8"),
            "kind": (3, "u8"),
        }
        return number(*counts[name], self.order)

    def frame(self, k):
        body = b"".join(self.word(name, k) for name in self.head)
        body += b"".join(number(value, self.kind, self.order) for value in self.values[k])
        if self.framing == "cobs":
            return cobs.encode(body + check_of(self.check, body, self.check_order)) + b"\0"
        covered = body if self.skips_sync else self.sync + body
        return self.sync + body + check_of(self.check, covered, self.check_order) + self.end

    def is_read_by(self, table):
        """Whether a description gives the charges of the last frames, in channels side by side."""
        parser = device_from_table({"frames": table}, "test").parser()
        got = np.array([frame.values for frame in parser.feed(self.data)])
        if len(got) < FRAMES - 3:
            return False
        for lag in (0, 1):
            sent = self.values[FRAMES - len(got) - lag : FRAMES - lag]
            for begin in range(got.shape[1] - self.electrodes + 1):
                if len(sent) == len(got) and np.allclose(got[:, begin : begin + self.electrodes], sent, rtol=1e-6):
                    return True
        return False

    def has_number_and_clock_of(self, table):
        names = {entry.get("name", "")[:2] for entry in table["fields"]}
        return all(("se" if name[0] == "s" else "t_") in names for name in self.head if name not in ("status", "kind"))


def test_frames_of_random_boards_are_recognised():
    """All but one at most: at rest, bytes that never change may belong to their neighbours or not."""
    wrong = []
    for seed in range(5000, 5024):
        board = RandomBoard(seed)
        table = recognise([board.data], FRAMES / RATE_HZ)
        if table is None or not board.is_read_by(table) or not board.has_number_and_clock_of(table):
            wrong.append((seed, vars(board) | {"values": None, "data": None}, table))
    assert len(wrong) <= 1, wrong


def test_frames_are_recognised_in_a_damaged_stream():
    """One byte of three hundred is wrong."""
    board, rng = RandomBoard(3), np.random.default_rng(0)
    damaged = np.frombuffer(board.data, np.uint8).copy()
    hit = rng.random(len(damaged)) < 0.003
    damaged[hit] ^= rng.integers(1, 256, hit.sum(), dtype=np.uint8)
    assert board.is_read_by(recognise([damaged.tobytes()], FRAMES / RATE_HZ))


@pytest.mark.parametrize("seed", range(2))
def test_noise_is_not_recognised(seed):
    table = recognise([np.random.default_rng(seed).bytes(20_000)], 2.0)
    assert table is None


def test_constant_bytes_and_nothing_are_not_recognised():
    nothing = b"", b"\xaa" * 1000, b"\xaa\x55\x01\x02\x03\x04" * 100
    assert [described_frames([data], 1.0) for data in nothing] == [None] * 3


@pytest.mark.parametrize("per_datagram", [1, 3])
def test_datagrams_of_plain_structs_are_recognised(per_datagram):
    values = np.random.default_rng(1).normal([5.0, -3.0, 0.0, 11.0], 0.3, (300, 4)).astype(np.float32)
    frames = [struct.pack("<I4f", k, *row) for k, row in enumerate(values)]
    chunks = [b"".join(frames[at : at + per_datagram]) for at in range(0, 300, per_datagram)]
    table = recognise(chunks, 1.5, are_datagrams=True)
    assert (table["framing"], table["length"]) == ("datagram", 20)
    assert [(entry["name"], entry["type"]) for entry in table["fields"]][:2] == [("seq", "u32"), ("ch1", "f32")]


def test_unnamed_crc_is_recognised_by_its_polynomial():
    """CRC-16 of an own start value over the payload alone: no catalogue has it."""
    crc = crcmod.mkCrcFun(0x11021, initCrc=0x1234, rev=False, xorOut=0x4321)
    rows = np.random.default_rng(2).normal([100, 200, -300], 20, (200, 3)).round().astype(int)
    datas = [struct.pack(">H3h", k, *row) for k, row in enumerate(rows.tolist())]
    stream = b"".join(b"\xaa\x55" + data + struct.pack(">H", crc(data)) for data in datas)
    table = recognise([stream], 1.0)
    assert table["checksum"]["polynomial"] == "1021"
    parser = device_from_table({"frames": table}, "test").parser()
    assert [frame.values for frame in parser.feed(stream)] == [tuple(map(float, row)) for row in rows.tolist()]
    assert parser.counts.crc_errors == 0


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
    """At 500 lines a second; a column whose ticks are of no usual unit stays a channel."""
    rng = np.random.default_rng(0)
    text = "\n" + "\n".join(lines(k, round(rng.normal(5.0, 0.3), 3)) for k in range(400)) + "\n"
    assert recognise([text.encode()], 0.8) == {"format": "text"} | expected


def test_header_of_a_csv_stream_becomes_part_of_the_device_file():
    """A board sends it once, at its start: who comes later reads the columns by the device file."""
    rng = np.random.default_rng(0)
    lines = [f"{k},{2 * k},{rng.normal(5.0, 0.3):.3f},{rng.normal(5.0, 0.3):.3f}" for k in range(400)]
    text = "\n".join(["n,millis,north,south", *lines]) + "\n"
    table = recognise([text.encode()], 0.8)
    assert table == {"format": "text", "columns": ["seq", "t_ms", "north", "south"]}
    parser = device_from_table({"frames": table, "channels": {"A": "south"}}, "test").parser()
    (*_, last) = parser.feed("\n".join(["", *lines[200:], ""]).encode())
    assert (last.seq, last.t_us, last.names) == (399, 798_000, ("north", "south"))
