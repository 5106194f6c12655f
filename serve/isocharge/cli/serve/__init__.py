"""Commands of `isocharge serve`, one module each.

May import: serve.pictures, shared.
"""
