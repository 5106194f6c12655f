"""`isocharge demo`: the whole path once, with pictures.

May import: all stages, when the command runs; shared.
"""
