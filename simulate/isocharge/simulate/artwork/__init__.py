"""A layout to scale, with straight leads, as DXF and SVG; and the folder of a design."""
