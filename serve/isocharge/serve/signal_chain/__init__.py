"""The signal chain, whose stages convert the values of a board to touch charges.

May import: frames, record, port, model, flags.
"""
