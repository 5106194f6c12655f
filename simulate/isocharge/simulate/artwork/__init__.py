"""Drawings of a layout to scale as DXF and SVG, straight leads, electrodes from DXF files, folder of a design."""
