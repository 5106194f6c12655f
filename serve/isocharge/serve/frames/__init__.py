"""Parsers from bytes to frames, one module for each wire format. They do not depend on a port.

May import: flags.

Each format has a parser class derived from `frame.Parser`, and a section class in `formats`. A device file names the
format by the tag of the section class.
"""
