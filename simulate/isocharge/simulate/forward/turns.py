"""Directions of presses and rotations of a probe at which presses are solved.

On a film that is not axisymmetric, the stress depends on the direction from the centre of the film to the press. Under
a probe that is not axisymmetric, it also depends on the rotation of the probe relative to this direction. A turn is a
pair of these two angles. In a frame that rotates with the probe, the stress at a node of the mesh is the Fourier series

    sum c_mk exp(i (2 m d + k r)),

where r is the rotation, and d is the direction plus the rotation. The film is the same after half a turn about its
centre, so only the even harmonics of d occur. If |m| increases, the coefficients decrease like a power of the
unevenness of the film. If |k| increases, they decrease like a power of the size of the probe divided by its distance
from the rim. If both increase, they decrease like the product of both powers. Therefore the series is cut off at a
smaller |k| if |m| is larger.

The presses are solved at the points of a lattice of rank one: the rotations r are evenly spaced over a full turn, and d
increases by the same step from each rotation to the next. The step is chosen such that no two terms of the series have
the same values at all points. The values at the points then determine all coefficients.
"""

import math
from dataclasses import dataclass
from itertools import count

import numpy as np

from isocharge.common.arrays import Array, Integers
from isocharge.simulate.sensor.film import Film
from isocharge.simulate.sensor.footprint import Probe


@dataclass(frozen=True)
class Turns:
    """Directions and rotations at which presses are solved.

    Attributes:
        direction: Directions from the centre of the film to the presses, plus the rotation of a probe that is not
            axisymmetric, shape (n_turn,), rad. They are zero if the film is axisymmetric.
        rotation: Rotations of the probe relative to the direction of the press, evenly spaced over a full turn, shape
            (n_turn,), rad. They are zero if the probe is axisymmetric.
        harmonics: Pairs (2 m, k) of the terms of the Fourier series, shape (n_term, 2).
        symmetry_order: Order of the rotational symmetry of the probe: the number of rotations within a full turn that
            map the probe onto itself. Only the first n_turn / symmetry_order turns are solved. The other turns
            describe the same presses, with the probe rotated by some of its periods.
    """

    direction: Array
    rotation: Array
    harmonics: Integers
    symmetry_order: int

    @classmethod
    def spread(cls, film: Film, probe: Probe, largest_harmonics: tuple[int, ...]) -> "Turns":
        """Choose the turns at which presses are solved, as few as determine the coefficients of a Fourier series.

        Args:
            film: Film on which the probe presses.
            probe: Probe that presses the film.
            largest_harmonics: Largest |k| of the terms of the series for |m| = 0, 1, 2, and so on; see the docstring of
                the module. For an axisymmetric film, only m = 0 is used. For an axisymmetric probe, only k = 0 is used.
        """
        largest_m = 0 if film.is_axisymmetric else len(largest_harmonics) - 1
        pairs: list[tuple[int, int]] = []  # (m, k) of each term
        for m in _symmetric_range(largest_m):
            largest_k = 0 if probe.is_axisymmetric else largest_harmonics[abs(m)]
            pairs.extend((m, k) for k in _symmetric_range(largest_k))
        harmonics = np.array(pairs)
        symmetry_order = 1 if probe.is_axisymmetric else round(2.0 * np.pi / probe.period)
        n_turn, step = _lattice(harmonics, symmetry_order)
        turn = np.arange(n_turn)
        return cls(
            direction=np.zeros(n_turn) if film.is_axisymmetric else np.pi * step * turn / n_turn,
            rotation=np.zeros(n_turn) if probe.is_axisymmetric else 2.0 * np.pi * turn / n_turn,
            harmonics=harmonics * np.array([2, 1]),
            symmetry_order=symmetry_order,
        )

    @property
    def solved(self) -> list[tuple[float, float]]:
        """Direction and rotation of each turn at which presses are solved."""
        n_solved = self.rotation.size // self.symmetry_order
        return list(zip(self.direction[:n_solved].tolist(), self.rotation[:n_solved].tolist(), strict=True))

    def weights(self, direction: Array, rotation: Array) -> Array:
        """Compute the weights that interpolate between the turns.

        Args:
            direction: Directions of the presses as in the attribute `direction`, shape (n,), rad.
            rotation: Rotations of the probe as in the attribute `rotation`, shape (n,) or (1,), rad.

        Returns:
            Weights, shape (n, n_turn). The weights of each press sum to 1.
        """
        angles = np.stack(np.broadcast_arrays(direction, rotation), axis=1)
        phase = angles @ self.harmonics.T  # shape (n, n_term)
        turn_phase = np.stack([self.direction, self.rotation], axis=1) @ self.harmonics.T  # shape (n_turn, n_term)
        terms = np.exp(1j * phase) @ np.exp(-1j * turn_phase).T
        return np.asarray(terms.real / self.rotation.size)


def _symmetric_range(largest: int) -> range:
    """Return the integers from -`largest` to `largest`."""
    return range(-largest, largest + 1)


def _lattice(harmonics: Integers, symmetry_order: int) -> tuple[int, int]:
    """Find the smallest lattice of turns at which no two harmonics have the same values.

    At the turn j of n, the angle d is pi s j / n and the rotation of the probe is 2 pi j / n, where s is the
    step. The harmonic (m, k) has the phase 2 pi (m s + k) j / n. Two harmonics therefore have the same values at all
    turns if and only if the remainders of m s + k after the division by n are equal. After one period of the probe,
    both angles must have increased by the period, so that s - 2 is a multiple of the symmetry order.

    Args:
        harmonics: Pairs (m, k), shape (n_term, 2).
        symmetry_order: Order of the rotational symmetry of the probe.

    Returns:
        Number of turns, which is a multiple of the symmetry order, and step.
    """
    min_period_count = math.ceil(len(harmonics) / symmetry_order)
    for period_count in count(min_period_count):
        n_turn = symmetry_order * period_count
        for step in range(2 % symmetry_order, n_turn, symmetry_order):
            remainders = (harmonics @ (step, 1)) % n_turn
            if len(set(remainders.tolist())) == len(harmonics):
                return n_turn, step
    raise AssertionError("a lattice with more turns than pairs of angles separates all harmonics")
