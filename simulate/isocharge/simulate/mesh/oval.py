"""Deformation of the mesh of a circular film into the mesh of an oval film.

The shape of an oval clamp is described by the complex number e exp(2 i alpha). In the direction `angle`, the rim of the
film lies at the distance 1 + e cos(2 (angle - alpha)) from the centre, in film radii. For a circular clamp, the complex
number is 0.

The class `placement.Placement` displaces the footprint without a deformation, and deforms only the rings of the mesh.
"""

import numpy as np

from isocharge.common.arrays import Array, Complexes
from isocharge.simulate.sensor.film import Film


def film_oval(film: Film, direction: float | Array) -> Complexes:
    """Return the complex number e exp(2 i alpha) that describes the shape of the clamp of a film.

    The angle alpha is measured from the direction of a press.

    Args:
        film: The film.
        direction: Direction from the centre of the film to the press, any shape, rad.
    """
    return np.asarray(film.oval * np.exp(2j * (film.oval_axis - direction)))


def oval_displacement(points: Complexes, oval: Complexes) -> Complexes:
    """Return the displacements of points by which a circular film is deformed into an oval film.

    Each point is displaced in the radial direction. The displacement increases with the fifth power of the distance
    from the centre. The point of the rim in the direction `angle` is displaced by e cos(2 (angle - alpha)) film radii.
    A search for electrode positions may examine points beyond the rim. A point beyond the rim is displaced like the
    point of the rim in the same direction.

    Args:
        points: Points x + iy of the circular film, any shape, in film radii.
        oval: Complex number that describes the clamp in the frame of the press, of a shape that broadcasts with the
            points.

    Returns:
        Displacements x + iy, same shape, in film radii.
    """
    points_of_disk = points / np.maximum(np.abs(points), 1.0)
    squared_distance = np.abs(points_of_disk) ** 2
    angular_factor = (np.conj(oval) * points_of_disk**2).real  # squared distance times e cos(2 (angle - alpha))
    return np.asarray(points_of_disk * squared_distance * angular_factor)


def circular_distance(distance: Array, oval: Complexes, reach: float) -> Array:
    """Convert the distance of a press from the centre of an oval film into the distance on the circular film.

    The deformation of the circular film into the oval film displaces the press in the radial direction. The
    displacement increases with the fifth power of the distance. A footprint that touches the rim of the circular film
    is displaced like the rim, so it also touches the rim of the oval film.

    Args:
        distance: Distance of the press from the centre of the oval film, any shape, in film radii.
        oval: Complex number that describes the clamp in the frame of the press, of the shape of `distance`.
        reach: Distance from the centroid of the footprint to its farthest point, in film radii.

    Returns:
        Distance before the displacement, same shape, in film radii.
    """
    rim_displacement = oval.real  # of the rim in the direction of the press
    largest_distance = 1.0 + rim_displacement - reach  # of a footprint that touches the rim
    return np.asarray(distance - rim_displacement * (distance / largest_distance) ** 5)
