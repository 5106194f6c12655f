"""Processing of a live stream, which converts the bytes of a board to prediction records.

May import: port, frames, signal_chain, prediction, flags.
"""
