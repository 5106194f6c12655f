"""Processing of a live stream, which converts the bytes of a board to prediction records.

May import: tracking, signal_chain, frames, record, port, model, flags.
"""
