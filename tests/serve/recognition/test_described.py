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
from isocharge.serve.recognition.recognise import recognise
from layout_encoder import encode_layout

FRAMES = 300
RATE_HZ = 200.0
TYPES = (
    *(("i16", 30.0), ("u16", 30.0), ("i24", 900.0), ("u24", 900.0), ("i32", 900.0)),
    *(("f32", 0.5), ("f32", 30.0), ("f64", 900.0)),
)
"""Types of channels with the standard deviations of their noise. Values with more noise than 1 are whole numbers."""

SYNCS = ("AA 55", "A5 5A", "EB 90", "7E", "FF FE", "24 50 5A")
HEAD_FIELDS = (
    *(
        {"name": name, "type": type_name}
        for name, *types in (("seq", "u8", "u16", "u32"), ("t_ms", "u16", "u32"), ("t_us", "u32", "i64"))
        for type_name in types
    ),
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
        seconds: Time in which the frames were sent, s.
    """

    def __init__(self, seed):
        rng = np.random.default_rng(seed)

        def pick(options):
            return options[rng.integers(len(options))]

        order = pick(("little", "big"))
        type_name, noise = pick(TYPES)
        electrodes = int(rng.integers(3, 5))
        sync = pick(SYNCS)
        checksum = pick(CHECKS)
        is_stuffed = pick((False, False, True))
        head = [pick(HEAD_FIELDS) for _ in range(rng.integers(0, 3))]
        # A frame has at most one counter and one clock.
        self.head = list({field.get("name", field.get("value"))[:2]: field for field in head}.values())
        skips_sync = rng.integers(2)
        end = pick((b"", b"", b"\r\n"))
        fields = self.head + [{"name": name, "type": type_name} for name in "ABCD"[:electrodes]]
        sizes = [int(field["type"].strip("iufpad") or 8) // 8 for field in fields]  # a constant has one byte
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

        zero = 1 << int(type_name[1:]) - 1 if type_name[0] == "u" else 0
        rest = zero + rng.uniform(-40, 40, electrodes) * noise
        values = rng.normal(rest, noise, (FRAMES, electrodes))
        self.values = np.round(values) if noise > 1.0 else values.astype(np.float32)

        layout = device_from_table({"frames": self.table}, "board").frames
        first_seq, uptime_us, lost_bytes = (int(rng.integers(limit)) for limit in (60_000, 1 << 32, 9))
        interval_us = 4000 + seed % 2 * 1000  # 250 or 200 Hz
        self.seconds = FRAMES * interval_us * 1e-6
        stream = b""
        for row, numbers in enumerate(self.values.tolist()):
            data = encode_layout(layout, Frame(first_seq + row, uptime_us + interval_us * row, tuple(numbers)))
            stream += cobs.encode(data) + b"\0" if is_stuffed else data + end
        self.data = stream[lost_bytes:]

    def is_read_by(self, table):
        """Return whether a description gives the counter, the clock and the values of the latest frames.

        The values must be in adjacent channels.
        """
        names = {entry.get("name", "")[:2] for entry in table["fields"]}
        if not {field["name"][:2] for field in self.head if "name" in field} <= names:
            return False
        parsed = parsed_values(table, self.data)
        electrodes = self.values.shape[1]
        for n_missing in (0, 1):  # at the end
            sent = self.values[FRAMES - len(parsed) - n_missing : FRAMES - n_missing]
            for first in range(parsed.shape[1] - electrodes + 1):
                channels = parsed[:, first : first + electrodes]
                if len(sent) == len(parsed) >= FRAMES - 3 and np.allclose(channels, sent, rtol=1e-6):
                    return True
        return False


def parsed_values(table, data):
    """Return the values of the frames that a description finds in data, shape (n, channels)."""
    frames = device_from_table({"frames": table}, "test").parser().feed(data)
    return np.array([frame.values for frame in frames], ndmin=2)


def test_frames_of_random_boards_are_recognised():
    wrong = []
    for seed in range(5000, 5010):
        board = RandomBoard(seed)
        table = recognise([board.data], board.seconds)
        if table is None or not board.is_read_by(table):
            wrong.append((seed, board.table, table))
    assert not wrong


def test_frames_are_recognised_in_a_damaged_stream():
    """About 0.3 % of the bytes are wrong."""
    board = RandomBoard(3)
    stream = np.frombuffer(board.data, np.uint8).copy()
    stream[np.random.default_rng(0).random(len(stream)) < 0.003] ^= 0x5A
    assert board.is_read_by(recognise([stream.tobytes()], board.seconds))


def recognised_fields(number_formats, head, values, rate_Hz=RATE_HZ):
    """Return the recognised fields of frames that begin with AA 55, followed by a number and the values of channels."""
    rows = np.column_stack([head, values]).round().astype(int).tolist()
    frames = [b"\xaa\x55" + struct.pack(number_formats, *numbers) for numbers in rows]
    return recognise(frames, FRAMES / rate_Hz)["fields"]


VALUES = np.random.default_rng(0).normal(0.0, 300.0, (FRAMES, 4)).round()
"""Values of four channels, shape (FRAMES, 4)."""


@pytest.mark.parametrize(("channel", "constant"), [(1, -7), (3, 0)])
def test_channel_that_never_changes_is_kept_beside_the_others(channel, constant):
    """The doctor can only report a dead channel that the description contains."""
    values = VALUES.copy()
    values[:, channel] = constant
    fields = recognised_fields("<H4h", range(FRAMES), values)
    assert [field["name"] for field in fields] == ["seq", "ch1", "ch2", "ch3", "ch4"]


def test_checksum_covers_at_least_two_bytes():
    """Every byte would be its own sum of 16 bits."""
    values = np.arange(100)
    assert not [*find_checks(np.array([values, values, 0 * values], np.uint8).T)]
    rows = np.array([values, 2 * values, 3 * values, 3 * values // 256], np.uint8).T
    assert next(find_checks(rows)).name == "sum-16"


PATTERN = np.random.default_rng(0).bytes(98)


@pytest.mark.parametrize(
    "data",
    [
        b"\xaa\x55\x01\x02\x03\x04" * 100,
        (PATTERN + PATTERN[::-1] + PATTERN[:54]) * 100,  # constant frames with many repeated pairs
        np.random.default_rng(0).bytes(40_000),
    ],
)
def test_noise_and_constant_bytes_are_not_recognised(data):
    assert recognise([data], 2.0) is None


DAMAGED_FRAMES = """
44deab000202031027010104802e44cc9500020303983a010104c06144b3cb00
020403204e010106206144e8e900020503a86101010440614425910001010101
01010106206144deab000202031027010104206144cc9500020303983a010104
c04844e8e900020503a861010104206144
"""


def test_first_byte_that_is_constant_in_too_few_rows_belongs_to_the_pattern():
    """A byte is constant in most frames. Behind the first frame, it is constant in too few of them."""
    assert recognise([bytes.fromhex(DAMAGED_FRAMES)], 1.0)["length"] == 14


NUMBERS = np.arange(FRAMES)


@pytest.mark.first_cases(4)
@pytest.mark.parametrize(
    ("number_format", "numbers", "rate_Hz", "field"),
    [
        ("B", NUMBERS % 256, RATE_HZ, {"name": "seq", "type": "u8"}),  # counter that wraps
        ("I", NUMBERS + (NUMBERS == 3), 1000.0, {"name": "t_ms", "type": "u32"}),  # repeats a millisecond
        ("H", NUMBERS // 2, 2000.0, {"name": "t_ms", "type": "u16"}),
        ("d", 3.8e9 + 2 * NUMBERS, 0.5, {"name": "t_s", "type": "f64"}),  # seconds since 1904, as in LabVIEW
        ("I", 2.0**21 / RATE_HZ * NUMBERS, RATE_HZ, {"name": "ch1", "type": "i16"}),  # low bytes of a Unix time
    ],
)
def test_number_before_the_channels_is_a_counter_or_a_clock_with_a_usual_rate(number_format, numbers, rate_Hz, field):
    assert recognised_fields(f"<{number_format}4h", numbers, VALUES, rate_Hz)[0] == pytest.approx(field)


def test_binary_frames_are_recognised_after_lines_of_text():
    """A board may print its settings when it starts."""
    board = RandomBoard(5003)
    table = recognise([b"gain 1.0, rate 200.0\n" * 12 + board.data], board.seconds)
    assert table["format"] == "described"
    assert board.is_read_by(table)


@pytest.mark.parametrize(("size", "start", "step"), [(1, 0, 1), (2, 0x9000, 1), (4, 0x03F0_0000, 5000)])
def test_constant_bytes_before_a_counter_or_clock_do_not_belong_to_it(size, start, step):
    """The number wraps or changes its high byte only after the doctor has listened."""
    numbers = (start + step * np.arange(20 * FRAMES)) % 256**size
    rows = np.resize(VALUES, (len(numbers), 4)).astype(">i2")
    heads = [b"\xaa\x55" + number.to_bytes(size, "big") for number in numbers.tolist()]
    frames = [head + row.tobytes() for head, row in zip(heads, rows, strict=True)]
    table = recognise([b"".join(frames[:FRAMES])], FRAMES / RATE_HZ)
    parser = device_from_table({"frames": table}, "test").parser()
    parsed = parser.feed(b"".join(frames))
    for frame in parsed:
        parser.sequence_flags(frame.seq)
    assert len(parsed) >= len(frames) - 1
    assert parser.counts.lost == parser.counts.repeated == parser.counts.restarts == 0
    if step > 1:
        assert set(np.diff([frame.t_us for frame in parsed]) % parser.t_us_modulus) == {step}


def test_number_does_not_begin_before_the_bytes_that_a_checksum_covers():
    """The third byte is constant and could be the high byte of the counter."""
    bodies = [struct.pack(">B4h", number, *row) for number, row in enumerate(VALUES[:200].astype(int).tolist())]
    frames = [b"\xaa\x55\x03" + body + bytes([sum(body) % 256]) for body in bodies]
    section = recognise(frames, len(bodies) / RATE_HZ)
    assert (section["checksum"], section["checksum_from"]) == ("sum-8", 3)
    assert section["fields"][0] == {"name": "seq", "type": "u8"}


def test_datagrams_are_recognised_even_if_a_line_feed_was_added_to_some():
    """A UDP socket adds a line feed to a datagram whose bytes are all printable."""
    datagrams = [struct.pack("<H4h", number, *row) for number, row in enumerate(VALUES[:200].astype(int).tolist())]
    datagrams[7::20] = [datagram + b"\n" for datagram in datagrams[7::20]]
    section = recognise(datagrams, 200 / RATE_HZ, are_datagrams=True)
    assert (section["framing"], section["length"], len(section["fields"])) == ("datagram", 10, 5)


@pytest.mark.parametrize(
    ("header", "notation", "rate_Hz", "expected"),
    [
        ("", "{k},{ms},{q}", 500, {"columns": ["seq", "t_ms", "ch1"]}),
        ("seq,millis,north,south", "{k},{ms},{q},1.5", 500, {"columns": ["seq", "t_ms", "north", "south"]}),
        ("", "{k}5;{q};7", 500, {}),
        ("", "17 {ms_of_second} {q}", 500, {}),
        ("", '{{"i": {k}, "at": {unix_s:.4f}, "x": {q}}}', 500, {"seq": "i", "t_s": "at"}),
        ("", "micros:{ms}000,q:{q}", 500, {"t_us": "micros"}),
        ("", "at:{late_ms},A:{q}", 1000, {"t_ms": "at"}),
        ("", "time_ms:{ms},A:{q}", 976, {"t_ms": "time_ms"}),
        ("", "millis:{ms},A:{q}", 1000, {"t_ms": "millis"}),
    ],
)
def test_counter_and_clock_columns_in_text_are_recognised(header, notation, rate_Hz, expected):
    """A column that increases with no usual unit is a channel. A clock may count about one millisecond per frame.

    A board sends a header only once, so that a program that starts later needs the names in the device file.
    """
    rng = np.random.default_rng(0)
    lines = []
    for k, q in enumerate(rng.normal(5.0, 0.3, 2000).round(3)):
        time_ms = 5000 + 1e3 / rate_Hz * k
        times = {"ms": int(time_ms), "late_ms": int(time_ms + 1.1 * rng.random()), "unix_s": 1.7e9 + time_ms / 1e3}
        lines.append(notation.format(k=k, q=q, ms_of_second=2 * k % 1000, **times))
    lines.insert(1000, header)
    assert recognise(["\n".join([*lines, ""]).encode()], 2000 / rate_Hz) == {"format": "text"} | expected


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parents[2] / "data" / "serial_text").glob("*.txt")), ids=lambda path: path.stem
)
def test_notations_of_public_firmware_are_text(path):
    """At rest, the electrodes A, B and C have 3, -2 and 5 pC, with a noise of 1 pC."""
    data = path.read_bytes()
    table = recognise([data], 0.3)
    assert table["format"] == "text"
    values = parsed_values(table, data)
    assert len(values) >= 58
    np.testing.assert_allclose(values.mean(axis=0), [3.0, -2.0, 5.0], atol=0.5)


@pytest.mark.parametrize(
    "line", ["G1 X{:.1f}Y2Z3 ;layer", "no numbers {:.0f}x", "v1.2.{:.0f} <- ok", "1.5,{:.0f}\x1f2.5,3.5,4.5"]
)
def test_printable_bytes_are_never_a_binary_format(line):
    lines = [f"{line}\r\n".format(value).encode() for value in np.random.default_rng(0).normal(500, 100, 400)]
    assert (recognise(lines, 1.0) or {"format": "text"})["format"] == "text"
