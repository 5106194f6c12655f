"""`isocharge serve ...`: one file a command.

May import: shared.
"""
