"""`isocharge train ...`: one file a command.

May import: train.bench, shared.
"""
