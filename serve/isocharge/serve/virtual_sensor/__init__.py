"""Virtual sensor, which is a pseudo-terminal that sends the frames of a board.

Presses and faults are scripted or random.

May import: frames.
"""
