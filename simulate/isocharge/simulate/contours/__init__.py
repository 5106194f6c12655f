"""Isocharge contours and triangulation: from the field, and graphically as the paper does."""
