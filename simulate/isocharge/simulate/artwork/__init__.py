"""Drawings of electrode layouts as DXF and SVG files, straight leads, and the reader of electrodes in DXF files."""
