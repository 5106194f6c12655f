"""Deformation of the mesh of a circular film into the mesh of an oval film.

The shape of an oval clamp is the complex number e exp(2 i alpha). In the direction `angle`, the rim of the film lies at
the distance 1 + e cos(2 (angle - alpha)) from the centre, in film radii. The shape of a circular clamp is 0.
"""

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.sensor.film import Film

UNDEFORMED_RADIUS = 0.5
"""Radius within which the mesh of an oval film is the same as the mesh of a circular film, in film radii."""


def film_oval(film: Film, direction: float | Array) -> Complexes:
    """Return the shape e exp(2 i alpha) of the clamp of a film, with alpha measured from the direction of a press.

    Args:
        film: The film.
        direction: Direction from the centre of the film to the press, any shape, rad.
    """
    return np.asarray(film.oval * np.exp(2j * (film.oval_axis - direction)))


def to_oval(points: Complexes, oval: complex | Complexes) -> Complexes:
    """Convert points of a circular film into points of an oval film.

    Each point is displaced in the radial direction. Points within `UNDEFORMED_RADIUS` remain unchanged. The point of
    the rim in the direction `angle` is displaced by e cos(2 (angle - alpha)) film radii.

    Args:
        points: Points x + iy of the circular film, any shape, in film radii.
        oval: Shape e exp(2 i alpha) of the clamp, a number or an array that broadcasts with the points.

    Returns:
        Points x + iy of the oval film, same shape, in film radii.
    """
    radius = np.maximum(np.abs(points), UNDEFORMED_RADIUS)  # the displacement ratio is zero at `UNDEFORMED_RADIUS`
    rim_displacement = (np.conj(oval) * (points / radius) ** 2).real  # e cos(2 (angle - alpha))
    return points * (1.0 + _displacement_ratio(radius) * rim_displacement)


def from_oval(points: Complexes, oval: complex | Complexes) -> Complexes:
    """Convert points of an oval film into points of a circular film. This function is the inverse of `to_oval`.

    The radius of each point on the circular film is computed by Newton's method with an approximate slope.

    Args:
        points: Points x + iy of the oval film, any shape, in film radii.
        oval: Shape e exp(2 i alpha) of the clamp, a number or an array that broadcasts with the points.

    Returns:
        Points x + iy of the circular film, same shape, in film radii.
    """
    if not np.any(oval):
        return points
    oval_radius = np.maximum(np.abs(points), UNDEFORMED_RADIUS)
    rim_displacement = (np.conj(oval) * (points / oval_radius) ** 2).real  # e cos(2 (angle - alpha))
    radius = oval_radius
    for _ in range(8):  # the error is then below 1e-10 for all accepted oval parameters
        displacement_ratio = _displacement_ratio(radius)
        residual = radius * (1.0 + displacement_ratio * rim_displacement) - oval_radius
        # If d(r) is the displacement ratio at the radius r, the derivative of r d(r) is d + r d', which is 7 d at the
        # rim. The factor 7 is used for all radii, because an approximate slope is sufficient for the convergence.
        slope = 1.0 + 7.0 * rim_displacement * displacement_ratio
        radius = radius - residual / slope
    return points * (radius / oval_radius)


def _displacement_ratio(radius: Array) -> Array:
    """Compute the relative displacement at a radius, divided by the relative displacement of the rim.

    A relative displacement is a displacement divided by the radius of the displaced point. The ratio increases with the
    third power of the distance from `UNDEFORMED_RADIUS`, and is 1 at the rim.

    Args:
        radius: Radii of at least `UNDEFORMED_RADIUS`, any shape, in film radii.
    """
    return ((radius - UNDEFORMED_RADIUS) / (1.0 - UNDEFORMED_RADIUS)) ** 3
