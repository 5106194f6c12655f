"""`isocharge train ...`: one file a command.

May import: isocharge.train and what it builds on, when a command runs; shared.
"""
