"""`isocharge train ...`: one file a command.

May import: shared.
"""
