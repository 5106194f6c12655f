"""What several commands share: options, forward maps, messages and bars on stderr, stopping, the virtual sensor.

May import: nothing else of isocharge.cli.
"""
