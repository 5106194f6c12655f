"""Encoder of frames with a described layout, as the firmware of a board writes them."""

import sys
from functools import partial

from isocharge.serve import encode_text
from isocharge.serve.frames.frame import FLAGS, SEQ, TIMES_US

LARGEST_FLOATS = {"f32": (2.0 - 2.0**-23) * 2.0**127, "f64": sys.float_info.max}
"""Largest number of each floating-point type (IEEE 754)."""


def packed_number(field, value, byte_order):
    """Return the number of a field in the form that `struct` packs. Counters wrap, and other numbers are limited."""
    number = value if field.name in (SEQ, FLAGS) else value / field.scale
    if field.type_name in LARGEST_FLOATS:
        largest = LARGEST_FLOATS[field.type_name]
        return min(max(number, -largest), largest)
    is_signed = field.type_name[0] == "i"
    smallest = -field.modulus // 2 if is_signed else 0
    if field.name in (SEQ, *TIMES_US):
        number = (round(number) - smallest) % field.modulus + smallest
    whole = round(min(max(number, smallest), smallest + field.modulus - 1))
    return whole.to_bytes(3, byte_order, signed=is_signed) if field.size == 3 else whole


def encode_layout(layout, frame):
    """Return the bytes of a frame, without byte stuffing and without a delimiter."""
    values = {SEQ: frame.seq or 0, FLAGS: frame.bits}
    values |= {name: (frame.t_us or 0) / unit_us for name, unit_us in TIMES_US.items()}
    values |= dict(zip(layout.columns.names, frame.values, strict=True))
    numbers = [packed_number(field, values[field.name], layout.byte_order) for field in layout.fields]
    data = bytearray(layout.sync + layout.body.pack(*numbers))
    position = len(layout.sync)
    for field in layout.fields_and_padding:
        if field.value:
            data[position : position + field.size] = bytes.fromhex(field.value)
        position += field.size
    return bytes(data) + layout.compute_checksum(bytes(data))


def encode_teleplot(frame):
    """Return a frame as lines of Teleplot, as its README describes them."""
    values = [("seq", frame.seq), *zip("ABC", frame.values, strict=True)]
    return "".join(f">{name}:{frame.t_us / 1e3:.3f}:{value:.7g}\n" for name, value in values).encode()


def encode_pairs(frame):
    """Return a frame as pairs of names and values in a line."""
    a, b, c = frame.values
    return f"seq:{frame.seq},t_us:{frame.t_us},A:{a:.7g},B:{b:.7g},C:{c:.7g}\n".encode()


TEXT_ENCODERS = {
    "csv": partial(encode_text, notation="csv"),
    "json": partial(encode_text, notation="json"),
    "pairs": encode_pairs,
    "teleplot": encode_teleplot,
}
"""Functions that write a frame as text, by the name of the notation."""
