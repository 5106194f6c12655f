"""Writer of drawings of electrode layouts (DXF and SVG), and reader of electrodes from DXF drawings."""
