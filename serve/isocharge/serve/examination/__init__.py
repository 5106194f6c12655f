"""The port check: listening, health of the channels, order of the electrodes, and a device file that fits the board.

May import: live, port, frames, recognition, signal_chain.
"""
