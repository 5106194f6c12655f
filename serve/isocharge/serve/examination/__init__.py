"""The port check, which examines the frames and the channels of a board and proposes a device file for the board.

May import: live, port, presses, frames, recognition, signal_chain.
"""
