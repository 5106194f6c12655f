"""From "plug in" to a right touch with what `serve doctor` says and writes, and nothing else.

Boards that are not ours: a film, an amplifier, a converter, and bytes packed by struct, json, cobs and crcmod, never by
the encoders of isocharge. Their frames go through the two steps of a user: the findings of doctor become a device file,
and a stream reads the board with it. What no doctor can see, the charge of one count, is given as doctor asks for it.
The touch is compared with the model's own answer on the true charges: 0.03 mm and 0.5 % of the force.
"""

import binascii
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import crcmod.predefined
import numpy as np
import pytest

from frame_formats import STUFFINGS
from isocharge.cli.serve.doctor import device_text
from isocharge.serve import Chunk, Predictor, TouchStream, load_device
from isocharge.serve.examination.listening import ReceivedData
from isocharge.serve.examination.port_check import examine_received
from isocharge.serve.port.serial_line import Request

RATE_HZ = 400.0
predictor = cache(Predictor)

modbus, maxim = map(crcmod.predefined.mkPredefinedCrcFun, ("modbus", "crc-8-maxim"))

FOUR, THREE = "four-25um-biaxial", "three-25um-biaxial"
PRESSES = {FOUR: [520.0, 610.0, 700.0, 590.0], THREE: [850.0, 790.0, 905.0]}
"""Touch charges, pC."""


def counts(charge_pC, pC_per_count, zero=0):
    return [round(q / pC_per_count) + zero for q in charge_pC]


def csv_counts(k, q):
    """Counts without a header: frame number, a clock of 16 bits that wraps, and six inputs, two of them constant."""
    a, b, c, d = counts(q, 0.05, 2048)
    clock = (65_000 + round(2.5 * k)) % 65536
    return f"{k % 256},{clock},{a},0,{b},{c},4095,{d}\r\n".encode()


def other_names(k, q):
    """JSON with unusual names of its keys."""
    names = dict(zip(("north", "east", "south", "west"), (round(x, 3) for x in q.tolist()), strict=True))
    return json.dumps({"id": "rig 7", "n": k, "uptime": round(12.0 + k / 400, 4), "q": names}).encode() + b"\n"


def length_prefixed(k, q):
    """Sync, length, payload and checksum, and a frame of another kind every 50 frames."""

    def frame(payload):
        data = bytes([len(payload)]) + payload
        return b"\x7e" + data + bytes([maxim(data)])

    status = frame(b"\x01" + struct.pack("<H", k)) if k % 50 == 0 else b""
    return status + frame(b"\x02" + struct.pack("<I4i", 2500 * k & 0xFFFFFFFF, *counts(q, 1e-3)))


def teleplot(k, q):
    return "".join(f">q{n}:{2.5 * k:.1f}:{x:.3f}§pC\n" for n, x in enumerate(q)).encode()


def arduino_plotter(_, q):
    """Values with constant limits, which fix the scale of the serial plotter of Arduino."""
    return ("Min:-1500,Max:1500," + ",".join(f"S{n}:{x:.3f}" for n, x in enumerate(q)) + "\r\n").encode()


def answer(_, q):
    """A line that the board sends when it is requested."""
    return ("\t".join(f"{x:.3f}" for x in q) + "\r\n").encode()


def modbus_reply(_, q):
    """The answer of a Modbus slave, with big-endian registers and a little-endian checksum."""
    data = struct.pack(">BBB4h", 17, 4, 8, *counts(q, 0.0625))
    return data + struct.pack("<H", modbus(data))


def volts(k, q):
    """Voltages of an inverting amplifier with 1 nF, whose zero is half of 3.3 V."""
    return (f"{k / 400:.4f};" + ";".join(f"{1.65 - x / 1000:.6f}" for x in q) + "\n").encode()


def bare_struct(k, q):
    """A struct as it is stored in memory, without header or checksum. A datagram contains one struct."""
    return struct.pack("<I4f", k, *q)


def stuffed_by_slip(k, q):
    delimiter, stuff = STUFFINGS["slip"]
    body = struct.pack(">H3f", k % 65536, *q)
    return stuff(body + struct.pack(">H", binascii.crc_hqx(body, 0))) + delimiter


def ticks(k, q):
    """A clock of 32768 Hz, a temperature, big-endian floats, and the ones' complement of the sum of all bytes."""
    data = b"\xff\xfa" + struct.pack(">IH4f", round(k * 81.92) & 0xFFFFFFFF, 2941 + k % 2, *q)
    return data + bytes([~sum(data[2:]) & 0xFF])


@dataclass(frozen=True)
class Kind:
    """A board for the test of doctor.

    Attributes:
        encode: Function that returns the frame of a number and charges (pC).
        gain: Section `gain` of the device file, which the user provides; empty if the board sends pC.
        model: Name of the model.
        url: Port of the board.
        request: Request to which the board answers; None if it sends by itself.
    """

    encode: Callable
    gain: dict = field(default_factory=dict)
    model: str = FOUR
    url: str = "/dev/ttyACM0"
    request: Request | None = None


ZOO = {
    "CSV counts, dead inputs": Kind(csv_counts, {"pC_per_unit": 0.05}),
    "JSON of other names": Kind(other_names),
    "length-prefixed": Kind(length_prefixed, {"pC_per_unit": 1e-3}),
    "Teleplot": Kind(teleplot),
    "Arduino plotter": Kind(arduino_plotter),
    "a board that is asked": Kind(answer, model=THREE, request=Request(b"?\n", 300.0)),
    "Modbus": Kind(modbus_reply, {"pC_per_unit": 0.0625}),
    "volts": Kind(volts, {"pC_per_unit": -1000.0}),
    "structs over UDP": Kind(bare_struct, url="udp://127.0.0.1:9"),
    "JSON over UDP": Kind(other_names, url="udp://127.0.0.1:9"),
    "SLIP": Kind(stuffed_by_slip, model=THREE),
    "odd ticks": Kind(ticks),
}


def chunks_of(kind):
    """Yield the chunks of a board: three frames each, 400 frames a second. After 270 chunks at rest comes a press."""
    press_pC = np.array(PRESSES[kind.model])
    rng = np.random.default_rng(len(press_pC))
    rest_pC = rng.uniform(-8.0, 8.0, len(press_pC))
    for number in range(270 + 57):
        charges_pC = rng.normal(rest_pC + press_pC * (number >= 270), 0.3, (3, len(press_pC)))
        data = b"".join(kind.encode(3 * number + k, charge_pC) for k, charge_pC in enumerate(charges_pC))
        yield Chunk(data, 1.7e9 + 3 * (number + 1) / RATE_HZ, 0)


def check_touch(records, model):
    """The end of a press is where the model sees it in the true charges."""
    pressed = [record for record in records if record.contact][20:]
    assert len(pressed) > 50
    expected = predictor(model).predict(PRESSES[model])
    x_mm, y_mm, force_N = np.mean([(record.x_mm, record.y_mm, record.force_N) for record in pressed], axis=0)
    assert np.hypot(x_mm - expected.x_mm, y_mm - expected.y_mm) < 0.03
    assert force_N == pytest.approx(expected.force_N, rel=0.005)
    assert not any({"restart", "gap"} & {*record.flags} for record in records)
    clock = [record.t_device_us for record in records if record.t_device_us is not None]
    assert (np.diff(clock) > 0).all()


@pytest.mark.parametrize("name", ZOO)
def test_a_board_gets_to_a_right_touch(name, tmp_path):
    kind = ZOO[name]
    model = predictor(kind.model)
    chunks = [*chunks_of(kind)]
    received = ReceivedData(kind.url, 115200, kind.request, chunks[:110], 0.825)
    findings = examine_received(received, electrodes=model.metadata.electrodes, gain=kind.gain)
    path = tmp_path / "board.toml"
    path.write_text(device_text(findings), "utf-8")
    stream = TouchStream(model, load_device(path))
    check_touch([record for chunk in chunks[110:] for record in stream.feed(chunk)], kind.model)
