"""Layouts as drawings for screen printing and etching: leads to the rim, SVG and DXF to scale.

May import: sensor, numerics.
"""
