"""Recognition of the format of a board from its bytes alone.

The format comprises framing, checksum, fields, columns, counter and clock.

The result is a table for the section `[frames]` of a device file. Nothing about the board is known in advance. If
several descriptions fit, the description with the smallest score is chosen. The score is the number of bits that a
description needs to encode the bytes.
"""
