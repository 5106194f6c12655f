"""Parts of a film that a coat stiffens, and the mean of both along their edges, where elements are cut.

Across an edge with the normal n the strain jumps by sym(a x n) = N a; displacement and traction go on. Within a band
along an edge, film and coated film count as a laminate of that normal, of phases i with the stiffness C_i and the
shares f_i (composite voxels: Kabel, Merkert and Schneider 2015). With the strain E of the mixture, that of a phase is

    E_i = E + N M_i^-1 (T E - N^T C_i E),   M_i = N^T C_i N,   T = (sum f_i M_i^-1)^-1 sum f_i M_i^-1 N^T C_i,

and the stress sum f_i C_i E_i. So the jump is in the energy and in what is read, and elements need no edge there; what
is left is of second order in the band's width over that of the coat, at its corners.
"""

from dataclasses import dataclass

import numpy as np

from isocharge.common.arrays import Array, Booleans, Complexes, Integers
from isocharge.simulate.numerics.polygon import area_in_disk, spare

DIFFERENCE = 0.1
"""Step of the differences that give the normal, in widths of the band."""


@dataclass(frozen=True, eq=False)
class Coating:
    """What stiffens parts of a film, in units of the film's radius.

    Attributes:
        layers: What is coated at least once, twice, ...: convex polygons without common area, corners x + iy,
            anticlockwise.
        band: Width of the band along the edges.
        bare: C over E of the film, shape (3, 3).
        added: What a coat adds to it, shape (3, 3).
    """

    layers: tuple[tuple[Complexes, ...], ...]
    band: float
    bare: Array
    added: Array

    def near(self, points: Complexes) -> Booleans:
        """Which points a coat may reach, of the shape of `points`."""
        return np.asarray(np.any([self._within(part, points) for part in self.layers[0]], axis=0))

    def moduli(self, points: Complexes) -> Array:
        """What is added to C over E at points, shape (..., 3, 3)."""
        shares, stiffness, strains = self._phases(points)
        return np.asarray(np.einsum("...i,iab,...ibc->...ac", shares, stiffness, strains) - self.bare)

    def film_strain(self, points: Complexes, strained: Array) -> Array:
        """Strain of the film at points, shape (n, 3), as coated as each is, from that of the mixture."""
        strains = self._phases(points)[2]
        return np.asarray(np.einsum("nab,nb->na", strains[np.arange(points.size), self._depth(points)], strained))

    def _within(self, part: Complexes, points: Complexes) -> Booleans:
        middle = part.mean()
        return np.asarray(np.abs(points - middle) < np.abs(part - middle).max() + self.band)

    def _shares(self, points: Complexes) -> Array:
        """Shares of the band's disk about each point that each layer covers, shape (..., n_layer)."""
        shares, radius = np.zeros((*points.shape, len(self.layers))), 0.5 * self.band
        for number, layer in enumerate(self.layers):
            for part in layer:
                close = self._within(part, points)
                shares[close, number] += area_in_disk(part, points[close], radius) / (np.pi * radius**2)
        return np.minimum(shares, 1.0)

    def _depth(self, points: Complexes) -> Integers:
        """How often each point is coated, of the shape of `points`."""
        covered = [np.any([spare(part, points) >= 0.0 for part in layer], axis=0) for layer in self.layers]
        return np.asarray(np.sum(covered, axis=0))

    def _phases(self, points: Complexes) -> tuple[Array, Array, Array]:
        """Shares of the phases, shape (..., n_phase), their C over E, shape (n_phase, 3, 3), and the matrices to their
        strains from that of the mixture, shape (..., n_phase, 3, 3)."""
        covered, step = self._shares(points), DIFFERENCE * self.band
        x, y = (self._shares(points + d).sum(-1) - self._shares(points - d).sum(-1) for d in (step, 1j * step))
        size = np.hypot(x, y)
        x, y = (np.divide(part, size, out=np.full_like(size, np.sqrt(0.5)), where=size > 0.0) for part in (x, y))
        shares = -np.diff(covered, prepend=1.0, append=0.0)
        across = np.zeros((*points.shape, 1, 3, 2))
        across[..., 0, 0, 0] = across[..., 0, 2, 1] = x
        across[..., 0, 1, 1] = across[..., 0, 2, 0] = y
        stiffness = self.bare + np.arange(len(self.layers) + 1)[:, None, None] * self.added
        traction = across.swapaxes(-1, -2) @ stiffness
        compliance = np.linalg.inv(traction @ across)
        weighted = shares[..., None, None] * compliance
        common = np.linalg.solve(weighted.sum(axis=-3), (weighted @ traction).sum(axis=-3))
        return shares, stiffness, np.eye(3) + across @ compliance @ (common[..., None, :, :] - traction)
