"""Processing of a live stream: device file, channels, stages of a contact, and prediction records.

May import: port, frames, signal_chain, prediction, flags.
"""
