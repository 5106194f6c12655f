"""Isocharge contours, and triangulation of presses from these contours."""
