"""Datasets of presses and charges: sampling plans, sweeps, and the file format.

May import: forward, solver, mesh, sensor, execution, numerics.
"""
