"""Drawings of electrode layouts as DXF and SVG files, straight leads, and a reader of DXF drawings with electrodes."""
