"""Formats in which boards send frames, and parsers that convert the received bytes to frames.

A device file selects the format with the key `format` of its section `[frames]`:

- `binary`: the binary frames of isocharge (module `binary`),
- `text`: lines of text (modules `text`, `line_notation` and `text_lines`),
- `described`: frames of fixed length whose layout the device file describes (module `frame_layout`),
- `auto`: `binary` or `text`, depending on the bytes (module `formats`).

Each format has two classes. The section class declares the other keys of the section `[frames]`, and creates the
parser. The parser class is derived from `frame.Parser`. A parser receives bytes and does not open a port.

May import: record, port, model, flags.
"""
