"""What a board sends, from its bytes alone: framing, checksum, fields, columns, number and clock.

Bytes in, a table for the section `[frames]` of a device file out. Nothing is known beforehand; of several descriptions
that fit, the one is taken in which the bytes need the fewest bits.
"""
