"""Parsers that convert bytes to frames, with one module for each wire format. The parsers do not depend on a port.

May import: prediction, record, port, flags.

Each format has two classes. The parser class is derived from `frame.Parser`, and the section class declares the keys of
the section `[frames]` in a device file. The key `format` of this section contains the tag of the section class.
"""
