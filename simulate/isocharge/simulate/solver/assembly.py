"""Direct solver for the linear equations of a mesh, with static condensation of the interior nodes.

A node in the interior of an element belongs to no other element. The unknowns of interior nodes are therefore
eliminated separately for each element, with dense matrices. The nodes on the sides of all elements form the skeleton of
the mesh. Only the matrix of the skeleton unknowns is factorised as a whole. For elements of order 4, the elimination of
the interior nodes reduces the number of unknowns by a factor of 2.3. The numbering of the unknowns and the sparsity
pattern of the matrix depend only on the template. The numbering and the pattern are therefore computed once for each
template.

The unknowns of a node are U1, U2 and W. If the theory includes bending, each node also has an auxiliary unknown, which
the class `mechanics.energy.Bending` describes. On the rim, U1, U2 and W are zero. On the line of symmetry of a half
template, U2 is zero if the field is even, and all unknowns except U2 are zero if the field is odd.

The trapped air behind the film resists deflections that compress the air. The stiffness matrix of the air is c v v',
where c is a number. The vector v contains the weights with which the deflections of the nodes contribute to the
displaced volume. The matrix c v v' couples all nodes, but has only rank one. Let K be the sparse matrix of the film
without the air. The system (K + c v v') x = b can be solved with the factorisation of K alone (Sherman and Morrison
1950). The solution is

    x = K^-1 b - y c (v' K^-1 b) / (1 + c v' y),   y = K^-1 v.

Fields that are odd about the line of symmetry do not change the volume of the air. For these fields, the matrix is K.

The dense matrices are small. The function `single_threaded_blas` limits computations with small matrices to one thread.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import lru_cache, partial

import numpy as np
from scipy.sparse import csc_matrix, eye_array
from scipy.sparse.linalg import SuperLU, splu
from threadpoolctl import ThreadpoolController

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mesh.template import Template

SolveTangent = Callable[[Array], Array]
"""Function that solves a linear system with a factorised tangent for the displacements at the nodes.

The argument is the right-hand side for (U1, U2, W) at the nodes, and the result is the solution. Both have the shape
(n_node, 3). In the solution, fixed unknowns are zero.
"""


class Assembly:
    """Linear solver for a given template and a given number of unknowns per node.

    Attributes:
        unknowns_per_node: Number of unknowns per node.
        free: Whether each unknown is free, shape (n_node, unknowns_per_node).
        interior_unknowns: Indices of the interior unknowns of each element, shape (n_element, n_interior).
        side_unknowns: Indices of the unknowns on the sides of each element, shape (n_element, n_side).
        skeleton: Indices of the free unknowns on sides, in the order of elimination, shape (n_skeleton,).
    """

    def __init__(self, template: Template, unknowns_per_node: int, odd: bool) -> None:
        """Number the unknowns, and compute the sparsity pattern of the skeleton matrix.

        The skeleton consists of the unknowns on the sides of the elements. The unknowns in the interior of an element
        are eliminated before the system is solved, so the matrix of the system contains only the skeleton unknowns.

        Args:
            template: Template of the mesh.
            unknowns_per_node: Number of unknowns per node.
            odd: Whether the fields are odd about the line of symmetry.
        """
        self.unknowns_per_node = unknowns_per_node
        self.free = _free_unknowns(template, unknowns_per_node, odd)

        # Compute the local indices of the unknowns on the sides of an element and in its interior. Within an element,
        # the unknowns are numbered component by component: first U1 of all nodes, then U2, and so on. The index of an
        # unknown is therefore component * n_local + node. The interior nodes have only the components U1, U2 and W,
        # because `mechanics.energy.Bending` has eliminated their auxiliary unknown.
        component = np.arange(unknowns_per_node)[:, None]
        displacement_component = component[:3]
        n_local = template.is_interior.size
        self._side_indices = (component * n_local + np.flatnonzero(~template.is_interior)).ravel()
        self._interior_indices = (displacement_component * n_local + np.flatnonzero(template.is_interior)).ravel()

        # Compute the global indices of the unknowns of each element. Globally, the unknowns are numbered node by node:
        # the index of an unknown is unknowns_per_node * node + component.
        unknown_indices = (unknowns_per_node * template.nodes[:, None] + component).reshape(len(template.nodes), -1)
        self.interior_unknowns = unknown_indices[:, self._interior_indices]
        self.side_unknowns = unknown_indices[:, self._side_indices]

        # The skeleton unknowns are the free unknowns on sides.
        is_in_skeleton = np.zeros(self.free.size, dtype=bool)
        is_in_skeleton[self.side_unknowns.ravel()] = True
        self.skeleton = np.flatnonzero(is_in_skeleton & self.free.ravel())
        self._compute_sparsity_pattern()

        # Sort the skeleton unknowns in the order of elimination, which is determined from the pattern of the unsorted
        # unknowns. Then compute the pattern again for the sorted unknowns, because it depends on their order.
        self.skeleton = self.skeleton[self._elimination_order()]
        self._compute_sparsity_pattern()

    def _elimination_order(self) -> Integers:
        """Return an order of the skeleton unknowns in which the factors of their matrix have few nonzero entries.

        The order is computed by the minimum-degree method. SuperLU returns the order only after a factorisation.
        Therefore an auxiliary matrix is factorised, which has the pattern of the skeleton matrix. The auxiliary matrix
        needs no pivoting, because its diagonal is dominant.

        Returns:
            Indices into `skeleton` in the order of elimination, shape (n_skeleton,).
        """
        pattern = self._skeleton_matrix(np.ones(self._indices.size))
        dominant_matrix = csc_matrix(pattern + pattern.sum() * eye_array(pattern.shape[0]))
        new_number = factorise(dominant_matrix, "MMD_AT_PLUS_A").perm_c  # of each present number
        return np.argsort(new_number)

    def _compute_sparsity_pattern(self) -> None:
        """Determine which entries of the skeleton matrix may be nonzero, and where the element matrices are added.

        The skeleton matrix is the matrix of the unknowns in `skeleton`, and is the sum of the matrices of all elements.
        Only the entries that may be nonzero are stored. They form an array that is sorted by columns, and within each
        column by rows (compressed sparse column format). The method sets three attributes:

        - `_entry_positions`: Position in this array to which each entry of each element matrix is added. Entries of
          fixed unknowns do not belong to the skeleton matrix. Such entries have the position after the last nonzero
          entry.
        - `_indices`: Row of each nonzero entry.
        - `_indptr`: Position at which each column begins, followed by the number of nonzero entries.
        """
        # Number the unknowns of the skeleton matrix. Fixed unknowns have the number -1.
        n_skeleton = self.skeleton.size
        skeleton_number = np.full(self.free.size, -1, dtype=np.intp)
        skeleton_number[self.skeleton] = np.arange(n_skeleton)

        # Row and column of each entry of the element matrices in the skeleton matrix
        side_numbers = skeleton_number[self.side_unknowns]
        n_element, n_side = side_numbers.shape
        shape = (n_element, n_side, n_side)
        row = np.broadcast_to(side_numbers[:, :, None], shape)
        column = np.broadcast_to(side_numbers[:, None, :], shape)
        is_free = (row >= 0) & (column >= 0)

        # Compute the index that each entry would have if all entries of the skeleton matrix, including zeros, were
        # stored column by column. The distinct indices in ascending order belong to the nonzero entries in their stored
        # order. Several entries of element matrices may be added to the same nonzero entry.
        dense_index = column[is_free] * n_skeleton + row[is_free]
        nonzero_index, stored_position = np.unique(dense_index, return_inverse=True)
        positions = np.full(shape, nonzero_index.size, dtype=np.intp)  # the position of the entries of fixed unknowns
        positions[is_free] = stored_position
        self._entry_positions = positions.ravel()

        # Compute the row of each nonzero entry, and the position of the first nonzero entry of each column.
        pattern_column, pattern_row = np.divmod(nonzero_index, n_skeleton)
        entries_per_column = np.bincount(pattern_column, minlength=n_skeleton)
        self._indices = pattern_row.astype(np.int32)
        self._indptr = np.append(0, np.cumsum(entries_per_column)).astype(np.int32)

    def factor(self, matrix: Array) -> SolveTangent:
        """Factorise the matrix of the mesh, which is the sum of the matrices of its elements.

        The unknowns in the interior of an element belong to this element only. Interior unknowns are eliminated element
        by element. The sparse matrix of the remaining unknowns is the skeleton matrix.

        Args:
            matrix: Symmetric element matrices, shape (n_element, unknowns_per_node, n_local, unknowns_per_node,
                n_local).

        Returns:
            Function that solves the linear system for a right-hand side.
        """
        interior = self._interior_indices
        sides = self._side_indices
        n_element, n_component, n_local, _, _ = matrix.shape
        element_matrix = matrix.reshape(n_element, n_component * n_local, n_component * n_local)

        # Eliminate the interior unknowns of each element (static condensation). With the blocks A (interior), B
        # (coupling) and C (sides), the Schur complement C - B' A^-1 B remains for the skeleton matrix.
        coupling = element_matrix[:, interior[:, None], sides]  # B
        interior_block = element_matrix[:, interior[:, None], interior]  # A
        interior_inverse = np.linalg.inv(interior_block).astype(float, copy=False)  # A^-1
        reduced_coupling = interior_inverse @ coupling  # A^-1 B
        side_block = element_matrix[:, sides[:, None], sides]  # C
        schur_complement = side_block - coupling.transpose(0, 2, 1) @ reduced_coupling

        # Add the Schur complements of all elements. All entries of fixed unknowns are added to an unused number after
        # the nonzero entries, which is then omitted.
        entry_count = self._indices.size + 1
        skeleton_entries = np.bincount(self._entry_positions, schur_complement.ravel(), entry_count)[:-1]
        skeleton_factor = factorise(self._skeleton_matrix(skeleton_entries), "NATURAL")
        return partial(self._solve, interior_inverse, coupling, reduced_coupling, skeleton_factor)

    def _solve(
        self,
        interior_inverse: Array,
        coupling: Array,
        reduced_coupling: Array,
        skeleton_factor: SuperLU,
        right: Array,
    ) -> Array:
        """Solve the linear system of a factorised matrix for the free unknowns.

        Args:
            interior_inverse: Inverse of the block of the interior unknowns of each element, shape
                (n_element, n_interior, n_interior).
            coupling: Block between interior unknowns and unknowns on sides, shape (n_element, n_interior, n_side).
            reduced_coupling: Product of `interior_inverse` and `coupling`, same shape as `coupling`.
            skeleton_factor: Factorisation of the matrix of the skeleton unknowns.
            right: Right-hand side for (U1, U2, W) at the nodes, shape (n_node, 3). The values of fixed unknowns are
                ignored.

        Returns:
            Solution (U1, U2, W) at the nodes, shape (n_node, 3). Fixed unknowns are zero.
        """
        padded_right = np.zeros(self.free.shape)  # (n_node, unknowns_per_node)
        padded_right[:, :3] = right  # the right-hand side of the auxiliary unknown of bending is zero
        flat_right = padded_right.ravel()

        # Eliminate the interior unknowns of each element from the right-hand side. `bincount` adds the contributions of
        # all elements to each unknown on a side.
        interior_right = flat_right[self.interior_unknowns][..., None]  # shape (n_element, n_interior, 1)
        interior_solution = interior_inverse @ interior_right
        coupled_right = coupling.transpose(0, 2, 1) @ interior_solution  # shape (n_element, n_side, 1)
        reduced_right = flat_right - np.bincount(self.side_unknowns.ravel(), coupled_right.ravel(), flat_right.size)

        # Solve for the unknowns of the skeleton.
        solution = np.zeros(flat_right.size)
        solution[self.skeleton] = skeleton_factor.solve(reduced_right[self.skeleton])

        # Compute the interior unknowns of each element from the unknowns on its sides.
        side_solution = solution[self.side_unknowns][..., None]  # shape (n_element, n_side, 1)
        correction = reduced_coupling @ side_solution
        solution[self.interior_unknowns] = (interior_solution - correction)[..., 0]
        return solution.reshape(self.free.shape)[:, :3]

    def _skeleton_matrix(self, entries: np.ndarray) -> csc_matrix:
        """Create the matrix of the skeleton unknowns.

        Args:
            entries: Entries of the sparsity pattern, in the order of the compressed sparse column format.
        """
        return csc_matrix((entries, self._indices, self._indptr), shape=(self.skeleton.size, self.skeleton.size))


def factorise(matrix: csc_matrix, column_order: str) -> SuperLU:
    """Factorise a symmetric matrix without pivoting.

    Args:
        matrix: The matrix.
        column_order: Name of a column ordering of SuperLU, which is the parameter `permc_spec` of SciPy.
    """
    return splu(matrix, permc_spec=column_order, diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _free_unknowns(template: Template, unknowns_per_node: int, odd: bool) -> np.ndarray:
    """Return which unknowns are free. All other unknowns are fixed at zero.

    The clamp fixes U1, U2 and W on the rim. On the line of symmetry, U2 is fixed if the field is even, and all unknowns
    except U2 are fixed if the field is odd.

    Args:
        template: Template of the mesh.
        unknowns_per_node: Number of unknowns per node.
        odd: Whether the fields are odd about the line of symmetry.

    Returns:
        Whether each unknown is free, shape (n_node, unknowns_per_node).
    """
    component = np.arange(unknowns_per_node)  # 0: U1, 1: U2, 2: W, 3: auxiliary unknown of bending
    is_displacement = component < 3
    is_u2 = component == 1
    is_fixed_on_axis = ~is_u2 if odd else is_u2

    free = np.ones((template.n_node, unknowns_per_node), dtype=bool)
    free[np.ix_(template.on_rim, is_displacement)] = False
    free[np.ix_(template.on_axis, is_fixed_on_axis)] = False
    return free


assembly = lru_cache(maxsize=16)(Assembly)
"""Function that returns the linear solver for the mesh of a template. Linear solvers are cached."""


def factor_tangent(
    elastic: ElasticFilm, field: Array, added_tension: float = 0.0, *, odd: bool = False
) -> SolveTangent:
    """Factorise the tangent of the film for given displacements, including the stiffness of trapped air.

    The tangent is K + c v v', where K is the matrix of the film, v contains the integration weights of the displaced
    volume, and c is the stiffness of the air. The formula of Sherman and Morrison needs only the factorisation of K.

    Args:
        elastic: Discrete model of the film.
        field: Scaled displacements (U1, U2, W) at the nodes, shape (n_node, 3).
        added_tension: Tension that is added to the pretension, in units of E_young A^2.
        odd: Whether the right-hand sides are odd about the line of symmetry of a half mesh.

    Returns:
        Function that solves linear systems with the tangent.
    """
    solver = assembly(elastic.mesh.template, elastic.unknowns_per_node, odd)
    solve_film = solver.factor(elastic.tangent(field, added_tension))
    back_pressure = elastic.back_pressure
    if back_pressure is None or elastic.groups.compression == 0.0 or odd:  # odd fields do not compress the air
        return solve_film

    # The air changes a solution x by -c / (1 + c v . y) (v . x) y, where y = K^-1 v is the response of the film to a
    # uniform pressure.
    weights = back_pressure.weights  # v
    uniform_pressure = np.zeros_like(field)
    uniform_pressure[:, 2] = weights
    response = solve_film(uniform_pressure)  # y
    response_volume = float(weights @ response[:, 2])  # v . y
    air_stiffness = back_pressure.stiffness(field[:, 2])  # c
    # A volume that the film would displace without the air raises the pressure by the following factor. The film gives
    # way to the higher pressure, so the factor is smaller than the stiffness of the air.
    pressure_per_volume = air_stiffness / (1.0 + air_stiffness * response_volume)

    def solve_with_air(right: Array) -> Array:
        """Solve the linear system with the stiffness of the film and of the air.

        Args:
            right: Right-hand side for (U1, U2, W) at the nodes, shape (n_node, 3).

        Returns:
            Solution (U1, U2, W) at the nodes, shape (n_node, 3).
        """
        field_without_air = solve_film(right)
        volume = float(weights @ field_without_air[:, 2])
        return field_without_air - pressure_per_volume * volume * response

    return solve_with_air


def single_threaded_blas() -> AbstractContextManager[object]:
    """Return a context manager within which BLAS uses only one thread.

    Operations on many small matrices are faster with one thread. Several threads would often wait for each other in
    busy loops. The waits are long if other processes use the remaining cores.
    """
    limiter: AbstractContextManager[object] = _blas_libraries().limit(limits=1, user_api="blas")
    return limiter


@lru_cache
def _blas_libraries() -> ThreadpoolController:
    """Return the controller of the BLAS libraries that NumPy and SciPy have loaded before the first call."""
    return ThreadpoolController()
