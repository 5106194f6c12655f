"""Isocharge contours and triangulation, computed from a charge map or by the graphical method of the paper."""
