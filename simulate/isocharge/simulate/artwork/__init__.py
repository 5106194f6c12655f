"""Writing of electrode layouts as drawings (DXF and SVG), and reading of electrodes from DXF drawings."""
