"""Recognition of the format in which a board sends frames, from the received bytes alone.

The format consists of the framing, the checksum, and the meanings of the fields or columns.

The result is a table for the section `[frames]` of a device file. No information about the board is needed. If several
descriptions of the format fit the bytes, the description with the lowest score is chosen. The score of a description is
the number of bits that are needed to encode the bytes with this description.
"""
