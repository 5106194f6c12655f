"""Virtual sensor: a pseudo-terminal that sends the frames of a board, with scripted or random presses and faults.

May import: frames.
"""
