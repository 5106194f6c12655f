"""Writing of electrode layouts as drawings (DXF and SVG) and as folders of a design."""
