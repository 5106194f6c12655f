"""What several commands share: options, words and bars on stderr, stopping, the virtual sensor.

May import: nothing else of isocharge.cli.
"""
