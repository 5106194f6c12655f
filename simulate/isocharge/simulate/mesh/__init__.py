"""The mesh that follows the probe: its topology, the conformal map that places it, its elements.

May import: sensor, numerics.
"""
