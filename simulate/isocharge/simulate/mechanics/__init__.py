"""The film's physics, dimensionless: membrane and bending energy, stress, and which theory a scene needs.

May import: mesh, sensor, numerics.
"""
