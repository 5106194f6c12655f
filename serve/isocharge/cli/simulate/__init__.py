"""`isocharge simulate ...`: one file a command.

May import: isocharge.simulate, when a command runs; shared.
"""
