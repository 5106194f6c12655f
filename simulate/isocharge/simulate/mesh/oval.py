"""Deformation of the mesh of a circular film into the mesh of an oval film.

The shape of an oval clamp is the complex number e exp(2 i alpha). In the direction `angle`, the rim of the film lies at
the distance 1 + e cos(2 (angle - alpha)) from the centre, in film radii. The shape of a circular clamp is 0.

The class `placement.Placement` displaces the footprint without a deformation, and deforms only the rings of the mesh.
"""

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.sensor.film import Film


def film_oval(film: Film, direction: float | Array) -> Complexes:
    """Return the shape e exp(2 i alpha) of the clamp of a film, with alpha measured from the direction of a press.

    Args:
        film: The film.
        direction: Direction from the centre of the film to the press, any shape, rad.
    """
    return np.asarray(film.oval * np.exp(2j * (film.oval_axis - direction)))


def oval_displacement(points: Complexes, oval: Complexes) -> Complexes:
    """Return the displacement of points that deforms a circular film into an oval film.

    Each point is displaced in the radial direction. The displacement increases with the fifth power of the distance
    from the centre. The point of the rim in the direction `angle` is displaced by e cos(2 (angle - alpha)) film radii.

    Args:
        points: Points x + iy of the circular film, any shape, in film radii.
        oval: Shape of the clamp in the frame of the press, which broadcasts with the points.

    Returns:
        Displacements x + iy, same shape, in film radii.
    """
    return np.asarray(points * np.abs(points) ** 2 * (np.conj(oval) * points**2).real)


def circular_distance(distance: Array, oval: Complexes, reach: float) -> Array:
    """Compute the distance of a press from the centre of the circular film.

    A footprint that touches the rim of the oval film also touches the rim of the circular film. The displacement of the
    footprint increases with the fifth power of the distance, up to that of the rim.

    Args:
        distance: Distance of the press from the centre of the oval film, any shape, in film radii.
        oval: Shape of the clamp in the frame of the press, of the shape of `distance`.
        reach: Distance from the centroid of the footprint to its farthest point, in film radii.

    Returns:
        Distance before the displacement, same shape, in film radii.
    """
    largest_distance = 1.0 + oval.real - reach  # of a footprint that touches the rim
    return np.asarray(distance - oval.real * (distance / largest_distance) ** 5)
