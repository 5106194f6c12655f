"""What is on a port and what is missing to get a touch: listening, health of the channels, a device file that fits.

May import: live, port, frames, recognition, signal_chain.
"""
