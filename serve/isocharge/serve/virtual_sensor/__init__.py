"""Virtual sensor, which sends the frames of a simulated board through a pseudo-terminal.

The presses are random or given by a script. A script can also contain faults of the transmission.

May import: frames.
"""
