"""`isocharge simulate ...`: one file a command.

May import: shared.
"""
