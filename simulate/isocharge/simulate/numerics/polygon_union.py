"""Unions of polygons in parts without common area; corners are x + iy, anticlockwise."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.numerics.polygon import area_of, bilinear, to_corners

NARROW = 1e-9
"""Distance below which corners, and heights of corners, are one, mm."""

SHARPEST = 0.1
"""Smallest 1 + cos of the angle by which a trace may turn, which is 154 degrees: a mitre grows with 1 / (1 + cos)."""


def is_simple(z: Complexes) -> bool:
    """Whether a polygon is anticlockwise and does not cross itself: it then covers its signed area, nothing twice."""
    area, around = area_of(to_corners(z)), np.abs(z - np.roll(z, 1)).sum()
    covered = sum(area_of(to_corners(part)) for part in union_parts([z]))
    return area > 0.0 and bool(abs(covered - area) < NARROW * around)


def union_parts(front: Sequence[Complexes], back: Sequence[Complexes] = ()) -> list[Complexes]:
    """The union of simple polygons, or what it has in common with the union of others, as trapezoids.

    Between two heights at which no corner lies and no edges cross, edges follow each other from left to right. What an
    edge downwards opens, one upwards closes.
    """
    polygons, parts = [*front, *back], []
    start, end = np.concatenate(polygons), np.concatenate([np.roll(z, -1) for z in polygons])
    behind = np.repeat(np.arange(len(polygons)) >= len(front), [z.size for z in polygons])
    opens = np.where(end.imag < start.imag, 1, -1)
    for low, high in pairwise(_heights(start, end)):
        between = np.flatnonzero((start.imag < 0.5 * (low + high)) != (end.imag < 0.5 * (low + high)))
        begin, step = start[between], (end - start)[between]
        at_low, at_high = (begin + (height - begin.imag) / step.imag * step for height in (low, high))
        order = np.argsort((at_low + at_high).real)
        edges = between[order]
        inside = np.cumsum(opens[edges] * ~behind[edges]) > 0
        if back:
            inside &= np.cumsum(opens[edges] * behind[edges]) > 0
        for left, right in order[np.flatnonzero(np.diff(inside, prepend=False))].reshape(-1, 2):
            parts.append(np.array([at_low[left], at_low[right], at_high[right], at_high[left]]))
    return parts


def _heights(start: Complexes, end: Complexes) -> Array:
    """Heights of corners and crossings of edges, rising."""
    step, offset = end - start, start - start[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):  # parallel edges do not cross
        turn = (np.conj(step[:, None]) * step).imag
        along, other = (np.conj(offset) * step).imag / turn, (np.conj(offset) * step[:, None]).imag / turn
        crosses = (along >= 0.0) & (along <= 1.0) & (other >= 0.0) & (other <= 1.0)
    crossing = (start[:, None] + np.where(crosses, along, 0.0) * step[:, None]).imag
    heights = np.unique(crossing)
    return np.asarray(heights[np.diff(heights, prepend=-np.inf) > NARROW])


def pieces(part: Complexes, longest: float) -> list[Complexes]:
    """A quadrilateral cut into some, or triangles, with sides no longer than `longest`."""
    sides = np.abs(np.roll(part, -1) - part)
    s, t = (np.linspace(0.0, 1.0, int(np.ceil(max(sides[k], sides[k + 2]) / longest)) + 1) for k in (0, 1))
    grid = bilinear(part, s[:, None], t)
    cells = [grid[[i, i + 1, i + 1, i], [j, j, j + 1, j + 1]] for i, j in np.ndindex(s.size - 1, t.size - 1)]
    distinct = [cell[np.abs(cell - np.roll(cell, 1)) > NARROW] for cell in cells]
    return [cell for cell in distinct if cell.size > 2]


def trace_outline(path: Complexes, width: float) -> Complexes:
    """Corners of a line of a width along a path: straight ends, mitred bends; NaN where it turns back sharply."""
    with np.errstate(divide="ignore", invalid="ignore"):
        normal = 1j * np.diff(path) / np.abs(np.diff(path))
        first, last = np.append(normal[:1], normal), np.append(normal, normal[-1:])
        turn = 1.0 + (first * np.conj(last)).real
        mitre = 0.5 * width * (first + last) / np.where(turn < SHARPEST, np.nan, turn)
    return np.append(path - mitre, (path + mitre)[::-1])
