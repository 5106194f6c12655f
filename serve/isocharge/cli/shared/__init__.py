"""Parts that several commands share: options, forward maps, output on the terminal, the live page, a virtual sensor.

May import: nothing else of isocharge.cli.
"""
