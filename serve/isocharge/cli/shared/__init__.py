"""What several commands share: options, words and bars on stderr, stopping, the virtual sensor.

May import: all stages, when a command runs; no other package of isocharge.cli.
"""
