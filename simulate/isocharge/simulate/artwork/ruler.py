"""The ruler under a drawing: with it a print shows whether its scale is right."""

RULER_MM, TICK_MM = 50.0, 10.0
"""Length of the ruler and distance of its ticks, mm."""

GAP_MM, SHORT_MM = 4.0, 1.5
"""Distance of the ruler from the film and length of a tick, mm."""


def ruler_lines_mm(film_radius_mm: float) -> list[tuple[float, float, float, float]]:
    """Lines (x1, y1, x2, y2) of the ruler under a film about the origin, y up, mm."""
    y, left = -film_radius_mm - GAP_MM, -0.5 * RULER_MM
    ticks = [left + TICK_MM * i for i in range(round(RULER_MM / TICK_MM) + 1)]
    return [(left, y, -left, y), *((x, y - SHORT_MM, x, y) for x in ticks)]


def drawing_height_mm() -> float:
    """How far the ruler and its text reach below the film, mm."""
    return GAP_MM + SHORT_MM + 3.0
