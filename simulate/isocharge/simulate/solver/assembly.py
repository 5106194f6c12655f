"""From element matrices to a linear solve: condensation of the elements' interiors, then a sparse direct solver.

A node inside an element touches no other element, so its unknowns are eliminated element by element in dense algebra,
and only the skeleton is factorised: 2.3 times fewer unknowns at order 4. Everything that depends on the template alone
(numbering, sparsity, where each entry goes) is done once.

Unknowns per node are U1, U2, W and, with bending, the carried Laplacian (see `mechanics.energy`). On the rim
the first three are fixed; on the line of symmetry of a half template U2 is, or, for fields that are odd about it, all
but U2.
"""

from functools import lru_cache

import numpy as np
from scipy.sparse import csc_matrix, eye_array, kron
from scipy.sparse.linalg import SuperLU, splu

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.mesh.template import Template


class Assembly:
    """Factorises K for one template and number of unknowns per node.

    Attributes:
        components: Unknowns per node.
        free: Which are not fixed, shape (n_node, components).
        inner_global: Numbers of the elements' interior unknowns, shape (n_element, n_inner).
        outer_global: Numbers of those on the elements' edges, shape (n_element, n_outer).
        skeleton: Numbers of those that are left to factorise.
        follow: Their values from those that do not hang; None if none hangs.
    """

    def __init__(self, mesh: Template, components: int, odd: bool = False) -> None:
        line = np.arange(mesh.resolution.order + 1)
        on_edge = (line == line[0]) | (line == line[-1])
        shell = (on_edge[:, None] | on_edge[None, :]).ravel()
        self.components = components
        self.free = _free(mesh, components, odd)
        within = np.arange(components)[:, None]  # an element's unknowns are numbered component by component
        self._outer, self._inner = ((within * shell.size + np.flatnonzero(part)).ravel() for part in (shell, ~shell))
        unknown = (components * mesh.nodes[:, None] + within).reshape(len(mesh.nodes), -1)
        self.inner_global = unknown[:, self._inner]
        self.outer_global = unknown[:, self._outer]
        in_skeleton = np.zeros(self.free.size, dtype=bool)
        in_skeleton[self.outer_global.ravel()] = True
        self.skeleton = np.flatnonzero(in_skeleton & self.free.ravel())
        number = np.full(self.free.size, -1, dtype=np.intp)
        number[self.skeleton] = np.arange(self.skeleton.size)
        self._pattern(number[self.outer_global])
        self.follow = None
        if mesh.constraint is not None:
            each = kron(mesh.constraint, eye_array(components)).tocsr()[self.skeleton][:, self.skeleton]
            self.follow = each[:, each.diagonal() > 0.0].tocsc()
        self._reorder()

    def _pattern(self, number: Integers) -> None:
        """Compressed columns of the skeleton matrix and where each element entry goes; fixed ones go past the end."""
        shape, size = (*number.shape, number.shape[1]), self.skeleton.size
        row, column = np.broadcast_to(number[:, :, None], shape), np.broadcast_to(number[:, None, :], shape)
        free = (row >= 0) & (column >= 0)
        key, place = np.unique(column[free] * size + row[free], return_inverse=True)
        self._place = np.full(shape, key.size, dtype=np.intp)
        self._place[free] = place
        self._place = self._place.ravel()
        self._indices = (key % size).astype(np.int32)
        self._indptr = np.concatenate([[0], np.cumsum(np.bincount(key // size, minlength=size))]).astype(np.int32)

    def _reorder(self) -> None:
        """Number the unknowns so that elimination in turn fills in little: the pattern alone decides, so once."""
        pattern = self._skeleton(np.ones(self._indices.size))
        dominant = csc_matrix(pattern + pattern.sum() * eye_array(pattern.shape[0]))
        order = np.argsort(_factorise(dominant, "MMD_AT_PLUS_A").perm_c)
        if self.follow is not None:
            self.follow = self.follow[:, order]
            return
        pattern.data = np.arange(pattern.nnz)
        numbered = pattern[:, order][order]
        numbered.sort_indices()
        self._place = np.append(np.argsort(numbered.data), numbered.nnz)[self._place]
        self._indices, self._indptr, self.skeleton = numbered.indices, numbered.indptr, self.skeleton[order]

    def factor(self, matrix: Array) -> "Factor":
        """Factorise K.

        Args:
            matrix: Element matrices, shape (n_element, n_local, components, n_local, components), symmetric.

        Returns:
            What solves K x = b for any b.
        """
        inner, outer = self._inner, self._outer
        size = matrix.shape[1] * self.components
        matrix = matrix.transpose(0, 2, 1, 4, 3).reshape(-1, size, size)
        coupling = matrix[:, inner[:, None], outer]
        inverse = np.linalg.inv(matrix[:, inner[:, None], inner]).astype(float, copy=False)
        reduced = inverse @ coupling
        schur = matrix[:, outer[:, None], outer] - coupling.transpose(0, 2, 1) @ reduced
        data = np.bincount(self._place, schur.ravel(), self._indices.size + 1)[:-1]
        return Factor(self, inverse, coupling, reduced, _factorise(self._skeleton(data), "NATURAL"))

    def _skeleton(self, data: np.ndarray) -> csc_matrix:
        """The skeleton matrix of the unknowns that do not hang."""
        matrix = csc_matrix((data, self._indices, self._indptr), shape=(self.skeleton.size, self.skeleton.size))
        return matrix if self.follow is None else csc_matrix(self.follow.T @ matrix @ self.follow)


class Factor:
    """A factorised K."""

    def __init__(self, assembly: Assembly, inverse: Array, coupling: Array, reduced: Array, skeleton: SuperLU) -> None:
        self._assembly = assembly
        self._inverse, self._coupling, self._reduced, self._skeleton = inverse, coupling, reduced, skeleton

    def solve(self, right: Array) -> Array:
        """Solve for the free unknowns.

        Args:
            right: Right-hand side for (U1, U2, W) on every node, shape (n_node, 3); fixed values are ignored.

        Returns:
            (U1, U2, W), shape (n_node, 3), zero where fixed.
        """
        parts = self._assembly
        padded = np.zeros(parts.free.shape)
        padded[:, :3] = right
        flat = padded.ravel()
        inside = self._inverse @ flat[parts.inner_global][..., None]
        carried = self._coupling.transpose(0, 2, 1) @ inside
        shifted = flat - np.bincount(parts.outer_global.ravel(), carried.ravel(), flat.size)
        solution = np.zeros(flat.size)
        skeleton = shifted[parts.skeleton]
        if parts.follow is not None:
            skeleton = parts.follow.T @ skeleton
        found = self._skeleton.solve(skeleton)
        solution[parts.skeleton] = found if parts.follow is None else parts.follow @ found
        back = self._reduced @ solution[parts.outer_global][..., None]
        solution[parts.inner_global] = (inside - back)[..., 0]
        return solution.reshape(parts.free.shape)[:, :3]


def _factorise(matrix: csc_matrix, order: str) -> SuperLU:
    return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _free(mesh: Template, components: int, odd: bool) -> np.ndarray:
    """Which unknowns are not fixed by clamping or symmetry, shape (n_node, components)."""
    free = np.ones((mesh.n_node, components), dtype=bool)
    free[mesh.on_rim, :3] = False
    free[np.ix_(mesh.on_axis, (np.arange(components) == 1) != odd)] = False
    return free


@lru_cache(maxsize=16)
def assembly(mesh: Template, components: int, odd: bool = False) -> Assembly:
    """The assembly of a template, built once."""
    return Assembly(mesh, components, odd)
