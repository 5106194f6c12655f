"""Stiffness of a film with a coat on some of its parts. The edges of the coat need not follow the elements.

Displacement and traction are continuous across an edge of the coat. The strain jumps by sym(a x n) = N a, where n is
the normal of the edge. Within a band along the edge, the bare film and the coated film are treated as a laminate with
this normal. This is the method of composite voxels (Kabel, Merkert and Schneider 2015). The phase i of the laminate has
the stiffness C_i and the volume share f_i. If E is the mean strain, the strain of a phase is

    E_i = E + N M_i^-1 (T E - N^T C_i E),   M_i = N^T C_i N,   T = (sum f_i M_i^-1)^-1 sum f_i M_i^-1 N^T C_i,

and the mean stress is sum f_i C_i E_i. The energy and the charges therefore include the jump of the strain, although it
lies within elements. The remaining error is proportional to the square of the ratio of two widths: the width of the
band and the width of the coat.
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
        layers: Areas with at least one layer of the coat, with at least two layers, and so on. Each area consists of
            convex polygons that do not overlap. The corners x + iy of a polygon are ordered anticlockwise, in film
            radii.
        band_width: Width of the band along the edges, in film radii.
        bare: Elasticity matrix C over E of the film, shape (3, 3).
        added: Addition of one layer of the coat to this matrix, shape (3, 3).
    """

    layers: tuple[tuple[Complexes, ...], ...]
    band_width: float
    bare: Array
    added: Array

    def near(self, points: Complexes) -> Booleans:
        """Return for each point whether it may lie on the coat or near the coat. The result is only a fast estimate.

        The result is true for all points on the coat and in the band, and also for some points near the coat. The
        result is false for distant points.

        Args:
            points: Film points x + iy, any shape, in film radii.
        """
        return np.asarray(np.any([self._is_near(part, points) for part in self.layers[0]], axis=0))

    def moduli(self, points: Complexes) -> Array:
        """Compute the addition of the coat to the elasticity matrix C over E.

        Args:
            points: Film points x + iy, shape (...), in film radii.

        Returns:
            Addition, shape (..., 3, 3).
        """
        laminate = self._laminate(points)
        # Sum over the phases i and the strain components b: f_i C_i E_i.
        mixture = np.einsum("...i,iab,...ibc->...ac", laminate.shares, laminate.stiffness, laminate.strain)
        return np.asarray(mixture - self.bare)

    def film_strain(self, points: Complexes, mean_strain: Array) -> Array:
        """Compute the strain at points from the mean strain of the laminate. Each point lies in one of the phases.

        Args:
            points: Film points x + iy, shape (n,), in film radii.
            mean_strain: Mean strain (E11, E22, 2 E12), shape (n, 3).

        Returns:
            Strain of the phase, shape (n, 3).
        """
        point = np.arange(points.size)
        phase = self._layer_count(points)
        strain_of_phase = self._laminate(points).strain[point, phase]  # shape (n, 3, 3)
        return np.asarray((strain_of_phase @ mean_strain[:, :, None])[:, :, 0])

    def _is_near(self, part: Complexes, points: Complexes) -> Booleans:
        """Return which points lie in the circumscribed circle of a polygon, enlarged by the width of the band."""
        middle = part.mean()
        return np.asarray(np.abs(points - middle) < np.abs(part - middle).max() + self.band_width)

    def _shares(self, points: Complexes) -> Array:
        """Compute the share that each layer of the coat covers of a small disk about each point.

        The diameter of the disk is the width of the band along the edges.

        Args:
            points: Film points x + iy, shape (...), in film radii.

        Returns:
            Covered area over the area of the disk, shape (..., n_layer).
        """
        radius = 0.5 * self.band_width
        disk_area = np.pi * radius**2
        shares = np.zeros((*points.shape, len(self.layers)))
        for layer_index, layer in enumerate(self.layers):
            for part in layer:  # the parts of a layer do not overlap
                is_near = self._is_near(part, points)
                shares[is_near, layer_index] += area_in_disk(part, points[is_near], radius) / disk_area
        return np.minimum(shares, 1.0)

    def _layer_count(self, points: Complexes) -> Integers:
        """Return the number of layers of the coat at each point, of the shape of `points`."""
        covered = [
            np.any([min_edge_cross_product(part, points) >= 0.0 for part in layer], axis=0) for layer in self.layers
        ]
        return np.asarray(np.sum(covered, axis=0))

    def _normal(self, points: Complexes) -> tuple[Array, Array]:
        """Compute the normal of the edge near each point from the gradient of the covered share.

        Args:
            points: Film points x + iy, any shape, in film radii.

        Returns:
            Components along x and y, each of the shape of `points`. Far from edges both are sqrt(1 / 2).
        """
        # Differences of the covered share along x and along y, summed over the layers
        step = NORMAL_STEP * self.band_width
        difference_x = self._shares(points + step).sum(-1) - self._shares(points - step).sum(-1)
        difference_y = self._shares(points + 1j * step).sum(-1) - self._shares(points - 1j * step).sum(-1)

        # Divide by the length, except where the share does not change.
        length = np.hypot(difference_x, difference_y)
        has_normal = length > 0.0
        normal_x = np.full_like(length, np.sqrt(0.5))
        normal_y = np.full_like(length, np.sqrt(0.5))
        np.divide(difference_x, length, out=normal_x, where=has_normal)
        np.divide(difference_y, length, out=normal_y, where=has_normal)
        return normal_x, normal_y

    def _laminate(self, points: Complexes) -> "_Laminate":
        """Compute the laminate of bare and coated film at each point.

        Phase i is the film with i layers of the coat. It has the volume share f_i and the elasticity matrix C_i. The
        strain of a phase is E + N a_i, where E is the mean strain and N a_i is a jump across the edge with the matrix N
        of `_normal_matrix`. The traction T E across the edge is the same in all phases:

            N^T C_i (E + N a_i) = T E,   M_i = N^T C_i N,   sum f_i a_i = 0,

        so that a_i = M_i^-1 (T - N^T C_i) E and T = (sum f_i M_i^-1)^-1 sum f_i M_i^-1 N^T C_i.

        Args:
            points: Film points x + iy, any shape, in film radii.

        Returns:
            Volume share and stiffness of each phase, and its strain for a unit mean strain. Phase i has i layers of the
            coat.
        """
        # `_shares` returns the shares with at least 1, 2, ... layers. Their differences are the shares with exactly
        # 0, 1, 2, ... layers.
        shares = -np.diff(self._shares(points), prepend=1.0, append=0.0)

        # Matrices of the phases, with the axes (..., phase, row, column)
        normal = self._normal_matrix(points)[..., None, :, :]  # N, which is the same for all phases
        layer_count = np.arange(len(self.layers) + 1)
        stiffness = self.bare + layer_count[:, None, None] * self.added  # C_i
        traction = normal.swapaxes(-1, -2) @ stiffness  # N^T C_i
        compliance = np.linalg.inv(traction @ normal)  # M_i^-1

        # Sums over the phases, and the strain of each phase for a unit mean strain
        weighted = shares[..., None, None] * compliance  # f_i M_i^-1
        common_traction = np.linalg.solve(weighted.sum(axis=-3), (weighted @ traction).sum(axis=-3))  # T
        strain = np.eye(3) + normal @ compliance @ (common_traction[..., None, :, :] - traction)
        return _Laminate(shares, stiffness, strain)

    def _normal_matrix(self, points: Complexes) -> Array:
        """Return the matrix N that converts the jump of the displacement derivative across an edge into a strain jump.

        Args:
            points: Film points x + iy, any shape, in film radii.

        Returns:
            Matrices, shape (..., 3, 2): the strain (E11, E22, 2 E12), then the component of the displacement.
        """
        normal_x, normal_y = self._normal(points)
        zero = np.zeros_like(normal_x)
        e11_row = np.stack([normal_x, zero], axis=-1)
        e22_row = np.stack([zero, normal_y], axis=-1)
        shear_row = np.stack([normal_y, normal_x], axis=-1)
        return np.stack([e11_row, e22_row, shear_row], axis=-2)


class _Laminate(NamedTuple):
    """Laminates of the bare film and of the film with one or more layers of the coat.

    Attributes:
        shares: Volume shares of the phases, shape (..., n_phase).
        stiffness: Elasticity matrices C over E of the phases, shape (n_phase, 3, 3).
        strain: Matrices that convert the mean strain into the strains of the phases, shape (..., n_phase, 3, 3).
    """

    shares: Array
    stiffness: Array
    strain: Array
