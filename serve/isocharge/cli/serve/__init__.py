"""`isocharge serve ...`: one file a command.

May import: serve.pictures, shared.
"""
