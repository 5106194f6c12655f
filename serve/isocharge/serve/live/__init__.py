"""Processing of a live stream from the bytes of a board to prediction records, with the settings of a device file.

May import: port, frames, signal_chain, prediction, flags.
"""
