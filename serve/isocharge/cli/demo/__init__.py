"""The command `isocharge demo`: simulation, training, live service and pictures in one run.

May import: serve, shared.
"""
