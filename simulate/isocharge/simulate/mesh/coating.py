"""Stiffness of a film with a coat on some of its parts.

The edges of the coat need not follow the sides of the elements. Across an edge of the coat, the displacement and the
traction are continuous, but the strain jumps. The jump of the strain is sym(a x n) = N a, where n is the normal of the
edge, a is a vector, and N is a matrix that depends on the normal. Within a band along the edge, the bare film and the
coated film are treated as a laminate whose layers are perpendicular to n. This treatment is the method of composite
voxels (Kabel, Merkert and Schneider 2015).

Phase i of the laminate has the elasticity matrix C_i and the volume share f_i. If E is the mean strain of the laminate,
the strain of phase i is

    E_i = E + N M_i^-1 (T E - N^T C_i E),   M_i = N^T C_i N,   T = (sum f_i M_i^-1)^-1 sum f_i M_i^-1 N^T C_i.

The mean stress of the laminate is sum f_i C_i E_i. The energy and the charges therefore account for the jump of the
strain, even where the edge of the coat crosses an element. The remaining error is proportional to (b / w)^2, where b is
the width of the band and w is the width of the coat.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.simulate.numerics.polygon import area_in_disk, min_edge_cross_product

NORMAL_STEP = 0.1
"""Step of the finite differences that determine the normal of an edge, in units of the width of the band."""


@dataclass(frozen=True, eq=False)
class Coating:
    """A coat on parts of a film.

    Attributes:
        layers: Area with at least one layer of the coat, area with at least two layers, and so on. Each area consists
            of convex polygons that do not overlap. The corners x + iy of a polygon are in anticlockwise order, in film
            radii.
        band_width: Width of the band along the edges, in film radii.
        film_moduli: Elasticity matrix C / E of the bare film, shape (3, 3).
        layer_moduli: Matrix that each layer of the coat adds to `film_moduli`, shape (3, 3).
    """

    layers: tuple[tuple[Complexes, ...], ...]
    band_width: float
    film_moduli: Array
    layer_moduli: Array

    def near(self, points: Complexes) -> Booleans:
        """Estimate quickly which points lie on the coat or near the coat.

        The result is true for all points on the coat and for all points within the band along its edges. The result may
        also be true for other points near the coat. The result is false for distant points.

        Args:
            points: Film points x + iy, any shape, in film radii.
        """
        return np.asarray(np.any([self._is_near(part, points) for part in self.layers[0]], axis=0))

    def moduli(self, points: Complexes) -> Array:
        """Compute the matrices that the coat adds to the elasticity matrix C / E of the film.

        Args:
            points: Film points x + iy, shape (...), in film radii.

        Returns:
            Added matrices, shape (..., 3, 3).
        """
        laminate = self._laminate(points)
        # The mean stress of the laminate is the sum of f_i C_i E_i over the phases i. The summation index b is the
        # strain component.
        laminate_moduli = np.einsum("...i,iab,...ibc->...ac", laminate.shares, laminate.moduli, laminate.strain)
        return np.asarray(laminate_moduli - self.film_moduli)

    def film_strain(self, points: Complexes, mean_strain: Array) -> Array:
        """Compute the strain at points from the mean strain of the laminate.

        The laminate is a mixture of bare film and coated film, with which the mesh replaces the sharp edges of the
        coat. Film with i layers of the coat is called phase i. The real film at a point consists of a single phase, so
        the strain at the point is the strain of this phase.

        Args:
            points: Film points x + iy, shape (n,), in film radii.
            mean_strain: Mean strain (E11, E22, 2 E12) of the laminate, shape (n, 3).

        Returns:
            Strain (E11, E22, 2 E12) at the points, shape (n, 3).
        """
        point_index = np.arange(points.size)
        phase = self._layer_count(points)  # phase i has i layers of the coat
        phase_strain = self._laminate(points).strain[point_index, phase]  # for a unit mean strain, shape (n, 3, 3)
        mean_strain_column = mean_strain[:, :, None]
        return np.asarray((phase_strain @ mean_strain_column)[:, :, 0])

    def _is_near(self, part: Complexes, points: Complexes) -> Booleans:
        """Return which points lie near a polygon.

        A point is near if it lies within a circle around the mean of the corners. The radius of the circle is the
        largest distance of a corner from the mean, plus the width of the band.

        Args:
            part: Corners x + iy of the polygon, shape (n,), in film radii.
            points: Film points x + iy, any shape, in film radii.
        """
        centre = part.mean()
        polygon_radius = np.abs(part - centre).max()
        return np.asarray(np.abs(points - centre) < polygon_radius + self.band_width)

    def _shares(self, points: Complexes) -> Array:
        """Compute which share of a small disk around each point is covered by each layer of the coat.

        The diameter of the disk is the width of the band along the edges.

        Args:
            points: Film points x + iy, shape (...), in film radii.

        Returns:
            Covered area divided by the area of the disk, shape (..., n_layer).
        """
        radius = 0.5 * self.band_width
        disk_area = np.pi * radius**2
        shares = np.zeros((*points.shape, len(self.layers)))
        for layer_index, layer in enumerate(self.layers):
            for part in layer:  # the covered areas are added, because the parts of a layer do not overlap
                is_near = self._is_near(part, points)  # the share of all other points is zero
                shares[is_near, layer_index] += area_in_disk(part, points[is_near], radius) / disk_area
        return np.minimum(shares, 1.0)  # a sum may exceed 1 by rounding errors

    def _layer_count(self, points: Complexes) -> Integers:
        """Return the number of layers of the coat at each point.

        Args:
            points: Film points x + iy, any shape, in film radii.
        """
        is_covered_by_layer = [
            np.any([min_edge_cross_product(part, points) >= 0.0 for part in layer], axis=0) for layer in self.layers
        ]
        return np.asarray(np.sum(is_covered_by_layer, axis=0))

    def _normal(self, points: Complexes) -> tuple[Array, Array]:
        """Compute the unit normal of the edge near each point from the gradient of the covered share.

        Args:
            points: Film points x + iy, any shape, in film radii.

        Returns:
            Components along x and y, each of the shape of `points`. Far from all edges, where the share does not
            change, both components are sqrt(1 / 2).
        """
        # Finite differences of the covered share along x and along y, summed over the layers
        step = NORMAL_STEP * self.band_width
        difference_x = self._shares(points + step).sum(-1) - self._shares(points - step).sum(-1)
        difference_y = self._shares(points + 1j * step).sum(-1) - self._shares(points - 1j * step).sum(-1)

        # Normalise the gradient. Where the gradient is zero, return an arbitrary unit vector.
        length = np.hypot(difference_x, difference_y)
        has_gradient = length > 0.0
        normal_x = np.full_like(length, np.sqrt(0.5))
        normal_y = np.full_like(length, np.sqrt(0.5))
        np.divide(difference_x, length, out=normal_x, where=has_gradient)
        np.divide(difference_y, length, out=normal_y, where=has_gradient)
        return normal_x, normal_y

    def _laminate(self, points: Complexes) -> "_Laminate":
        """Compute the laminate of bare and coated film at each point.

        Phase i is the film with i layers of the coat, with the volume share f_i and the elasticity matrix C_i. The
        strain of phase i is E + N a_i, where E is the mean strain, N is the matrix of `_normal_matrix`, and a_i is a
        vector. The traction T E across the edge is the same in all phases. The vectors a_i and the matrix T follow from
        the equations

            N^T C_i (E + N a_i) = T E,   sum f_i a_i = 0.

        With M_i = N^T C_i N, the solution is a_i = M_i^-1 (T - N^T C_i) E and T = (sum f_i M_i^-1)^-1 sum f_i M_i^-1
        N^T C_i.

        Args:
            points: Film points x + iy, any shape, in film radii.
        """
        # `_shares` returns the shares with at least 1, 2, ... layers. The shares with exactly 0, 1, 2, ... layers are
        # the differences between successive shares, where the share with at least 0 layers is 1.
        shares = -np.diff(self._shares(points), prepend=1.0, append=0.0)

        # Matrices of the phases, with the axes (..., phase, row, column)
        normal = self._normal_matrix(points)[..., None, :, :]  # N, which is the same for all phases
        layer_count = np.arange(len(self.layers) + 1)
        moduli = self.film_moduli + layer_count[:, None, None] * self.layer_moduli  # C_i
        traction = normal.swapaxes(-1, -2) @ moduli  # N^T C_i
        compliance = np.linalg.inv(traction @ normal)  # M_i^-1

        # Sums over the phases, and the strain of each phase for a unit mean strain
        weighted_compliance = shares[..., None, None] * compliance  # f_i M_i^-1
        compliance_sum = weighted_compliance.sum(axis=-3)
        traction_sum = (weighted_compliance @ traction).sum(axis=-3)
        common_traction = np.linalg.solve(compliance_sum, traction_sum)[..., None, :, :]  # T
        strain = np.eye(3) + normal @ compliance @ (common_traction - traction)
        return _Laminate(shares, moduli, strain)

    def _normal_matrix(self, points: Complexes) -> Array:
        """Compute the matrix N that converts the jump of the displacement derivative at an edge into the strain jump.

        Args:
            points: Film points x + iy, any shape, in film radii.

        Returns:
            Matrices, shape (..., 3, 2). The rows are the strain components (E11, E22, 2 E12), and the columns are the
            displacement components.
        """
        normal_x, normal_y = self._normal(points)
        zero = np.zeros_like(normal_x)
        e11_row = np.stack([normal_x, zero], axis=-1)
        e22_row = np.stack([zero, normal_y], axis=-1)
        shear_row = np.stack([normal_y, normal_x], axis=-1)
        return np.stack([e11_row, e22_row, shear_row], axis=-2)


class _Laminate(NamedTuple):
    """Laminate of the bare film and of the film with one or more layers of the coat.

    Phase i of the laminate is the film with i layers of the coat.

    Attributes:
        shares: Volume shares of the phases, shape (..., n_phase).
        moduli: Elasticity matrices C / E of the phases, shape (n_phase, 3, 3).
        strain: Matrices that convert the mean strain into the strains of the phases, shape (..., n_phase, 3, 3).
    """

    shares: Array
    moduli: Array
    strain: Array
