"""From "plug in" to a right touch with what `serve doctor` says and writes, and nothing else.

Each board goes through the two commands as a user does: doctor listens and writes a device file, stream reads the board
with it. What no doctor can see, the charge of one count, is given as an option, as doctor asks for it. The touch is
compared with the model's own answer on the true charges: 0.03 mm and 0.5 % of the force.
"""

import binascii
import json
import struct
import zlib
from dataclasses import dataclass, field

import crcmod.predefined
import numpy as np
import pytest
from cobs import cobs

from isocharge.serve import Predictor

ccitt, modbus, x25, maxim = map(
    crcmod.predefined.mkPredefinedCrcFun, ("crc-ccitt-false", "modbus", "x-25", "crc-8-maxim")
)

FOUR, THREE = "four-25um-biaxial", "three-25um-biaxial"
PRESSES = {FOUR: [520.0, 610.0, 700.0, 590.0], THREE: [850.0, 790.0, 905.0]}
"""Touch charges, pC."""


def counts(charge_pC, pC_per_count, zero=0):
    return [round(q / pC_per_count) + zero for q in charge_pC]


def i24(count, order):
    return int(count).to_bytes(3, order, signed=True)


def big_24_bit(k, q):
    """24 bits, big-endian, as an ADS131 gives them; the checksum skips the sync."""
    body = struct.pack(">H", k % 65536) + b"".join(i24(c, "big") for c in counts(q, 2e-4))
    return b"\xa5\x5a" + body + struct.pack(">H", ccitt(body))


def offset_binary(k, q):
    """16 bits about half scale, a clock of 16 bits, sum of all bytes."""
    data = b"\xaa\x0c" + struct.pack("<H4H", (65_000 + round(2.5 * k)) % 65536, *counts(q, 0.0625, 32768))
    return data + bytes([sum(data) & 0xFF])


def csv_counts(k, q):
    """Counts without a header: number, a clock of 16 bits that wraps, six inputs of which two are dead."""
    a, b, c, d = counts(q, 0.05, 2048)
    clock = (65_000 + round(2.5 * k)) % 65536
    return f"{k % 256},{clock},{a},0,{b},{c},4095,{d}\r\n".encode()


def other_names(k, q):
    """JSON with names of its own."""
    names = dict(zip(("north", "east", "south", "west"), (round(x, 3) for x in q.tolist()), strict=True))
    return json.dumps({"id": "rig 7", "n": k, "uptime": round(12.0 + k / 400, 4), "q": names}).encode() + b"\n"


def length_prefixed(k, q):
    """Sync, length, payload, checksum; now and then a frame of another kind."""

    def frame(payload):
        data = bytes([len(payload)]) + payload
        return b"\x7e" + data + bytes([maxim(data)])

    status = frame(b"\x01" + struct.pack("<H", k)) if k % 50 == 0 else b""
    return status + frame(b"\x02" + struct.pack("<I4i", 2500 * k & 0xFFFFFFFF, *counts(q, 1e-3)))


def teleplot(k, q):
    return "".join(f">q{n}:{2.5 * k:.1f}:{x:.3f}§pC\n" for n, x in enumerate(q)).encode()


def arduino_plotter(_, q):
    """Fixed lines for the scale, as the serial plotter wants them."""
    return ("Min:-1500,Max:1500," + ",".join(f"S{n}:{x:.3f}" for n, x in enumerate(q)) + "\r\n").encode()


def answer(_, q):
    """A line on request."""
    return ("\t".join(f"{x:.3f}" for x in q) + "\r\n").encode()


def modbus_reply(_, q):
    """The answer of a Modbus slave: big-endian registers, the checksum little-endian."""
    data = struct.pack(">BBB4h", 17, 4, 8, *counts(q, 0.0625))
    return data + struct.pack("<H", modbus(data))


def volts(k, q):
    """An inverting amplifier of 1 nF about half of 3.3 V."""
    return (f"{k / 400:.4f};" + ";".join(f"{1.65 - x / 1000:.6f}" for x in q) + "\n").encode()


def bare_struct(k, q):
    """A struct as it lies in memory; the datagram is its frame."""
    return struct.pack("<I4f", k, *q)


def stuffed_by_cobs(k, q):
    body = struct.pack("<BH", 3, k % 65536) + b"".join(i24(c, "little") for c in counts(q, 1e-3))
    return cobs.encode(body + struct.pack("<I", zlib.crc32(body))) + b"\0"


def stuffed_by_slip(k, q):
    body = struct.pack(">H3f", k % 65536, *q)
    data = body + struct.pack(">H", binascii.crc_hqx(body, 0))
    return data.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + b"\xc0"


def sentence(k, q):
    content = "PZT," + ",".join(map(str, [k % 1000, *counts(q, 0.02)]))
    check = 0
    for byte in content.encode():
        check ^= byte
    return f"${content}*{check:02X}\r\n".encode()


def converter_of_eight(k, q):
    """Eight inputs of 24 bits with a status byte, of which the first four are wired; a byte that ends the frame."""
    wired = b"".join(i24(c, "big") for c in counts(q, 1e-3))
    return b"\xa0" + bytes([k & 0xFF]) + wired + bytes(12) + b"\x00\xc0"


def ticks(k, q):
    """A clock of 32768 Hz, a temperature, doubles' little sisters in big-endian, ones' complement of the sum."""
    data = b"\xff\xfa" + struct.pack(">IH4f", round(k * 81.92) & 0xFFFFFFFF, 2941 + k % 2, *q)
    return data + bytes([~sum(data[2:]) & 0xFF])


@dataclass(frozen=True)
class Kind:
    """A board, the options that doctor asks for, and where it is plugged in."""

    encode: object
    words: tuple[str, ...] = ()
    line: str = "pty"
    model: str = FOUR
    asks: str = ""
    options: dict = field(default_factory=dict)


ZOO = {
    "24 bits, big-endian": Kind(big_24_bit, ("--pC-per-unit", "2e-4"), asks="--pC-per-unit"),
    "offset binary": Kind(offset_binary, ("--pC-per-unit", "0.0625"), asks="--pC-per-unit"),
    "CSV counts, dead inputs": Kind(csv_counts, ("--pC-per-unit", "0.05"), asks="--pC-per-unit"),
    "JSON of other names": Kind(other_names),
    "length-prefixed": Kind(length_prefixed, ("--pC-per-unit", "1e-3"), asks="--pC-per-unit"),
    "Teleplot": Kind(teleplot),
    "Arduino plotter": Kind(arduino_plotter),
    "half-duplex with echo": Kind(
        answer, ("--request", r"?\n", "--request-Hz", "300"), "asked", THREE, options={"request": b"?\n"}
    ),
    "Modbus over TCP": Kind(modbus_reply, ("--pC-per-unit", "0.0625"), "tcp", asks="--pC-per-unit"),
    "volts": Kind(volts, ("--V-per-unit", "-1", "--feedback-pF", "1000"), asks="--feedback-pF"),
    "structs over UDP": Kind(bare_struct, line="udp"),
    "JSON over UDP": Kind(other_names, line="udp"),
    "COBS": Kind(stuffed_by_cobs, ("--pC-per-unit", "1e-3"), asks="--pC-per-unit"),
    "SLIP": Kind(stuffed_by_slip, model=THREE),
    "sentences": Kind(sentence, ("--pC-per-unit", "0.02"), asks="--pC-per-unit"),
    "eight inputs": Kind(converter_of_eight, ("--pC-per-unit", "1e-3"), asks="--pC-per-unit"),
    "odd ticks": Kind(ticks),
}


@pytest.fixture
def diagnosed(command, tmp_path, plug_in, board):
    """Plug a board in, and let doctor write its file: (board, file, what doctor says)."""

    def diagnose(kind, *words, name="board.toml"):
        plugged = plug_in(board(kind.encode, np.array(PRESSES[kind.model]), kind.line, **kind.options))
        path = tmp_path / name
        code, out, err = command(
            "serve", "doctor", "--port", plugged.url, "--seconds", "0.8", "--model", kind.model, "--write", path, *words
        )
        assert code == 0, out + err
        return plugged, path, out

    return diagnose


def touch(command, plugged, path, model):
    """The mean of position (mm) and force (N) over the end of a press, and all records."""
    plugged.press_in(0.8)
    code, out, err = command("serve", "stream", model, "--port", plugged.url, "--device", path, "--count", "500")
    assert code == 0, err
    records = [json.loads(line) for line in out.splitlines()]
    pressed = [record for record in records if record["contact"]][20:]
    assert len(pressed) > 50, err
    assert all("restart" not in record["flags"] and "gap" not in record["flags"] for record in records), err
    return np.mean([[record[key] for key in ("x_mm", "y_mm", "force_N")] for record in pressed], axis=0), records


@pytest.mark.parametrize("name", ZOO)
def test_a_board_gets_to_a_right_touch(name, diagnosed, command):
    kind = ZOO[name]
    plugged, path, words = diagnosed(kind, *kind.words)
    assert "not one byte" not in words
    (x_mm, y_mm, force_N), records = touch(command, plugged, path, kind.model)
    expected = Predictor(kind.model).predict(PRESSES[kind.model])
    assert np.hypot(x_mm - expected.x_mm, y_mm - expected.y_mm) < 0.03
    assert abs(force_N / expected.force_N - 1.0) < 0.005
    clock = [record["t_device_us"] for record in records if record["t_device_us"] is not None]
    assert (np.diff(clock) > 0).all()


@pytest.mark.parametrize("name", ["offset binary", "CSV counts, dead inputs", "volts"])
def test_what_cannot_be_seen_is_asked_for(name, diagnosed, command):
    """Raw counts are never called pC, and a file without their charge is refused, not guessed."""
    kind = ZOO[name]
    plugged, path, words = diagnosed(kind)
    assert kind.asks in words
    table = words[words.index("channel ") :].splitlines()[0]
    assert "pC" not in table
    code, _, err = command("serve", "stream", kind.model, "--port", plugged.url, "--device", path, "--seconds", "1")
    assert (code, "gain.pC_per_unit" in err) == (2, True)


def test_three_channels_for_a_model_of_four(diagnosed, command, board, plug_in):
    """The models that this board can serve are named, and one of them works with the file."""
    plugged = plug_in(board(answer, np.array(PRESSES[THREE])))
    code, out, err = command("serve", "doctor", "--port", plugged.url, "--seconds", "1", "--model", FOUR)
    assert "3 channels, but the model has the electrodes ('A', 'B', 'C', 'D')" in out
    assert f"models of 3 electrodes: {THREE}" in err
    assert code == 0
    kind = Kind(answer, model=THREE)
    plugged, path, _ = diagnosed(kind)
    (x_mm, y_mm, force_N), _ = touch(command, plugged, path, THREE)
    expected = Predictor(THREE).predict(PRESSES[THREE])
    assert np.hypot(x_mm - expected.x_mm, y_mm - expected.y_mm) < 0.03
    assert abs(force_N / expected.force_N - 1.0) < 0.005
