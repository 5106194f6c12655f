"""The live path: device file, channels, stream of prediction records, outputs, and the check of a port.

May import: port, frames, signal_chain, prediction, flags.
"""
