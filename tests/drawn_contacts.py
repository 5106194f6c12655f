"""Random contacts."""

import numpy as np


def draw_contacts(seed, count, radius, forces, inner_radius=0.0):
    """Draw contacts that are uniform over a ring and over the logarithm of the force, shape (count, 3), mm and N.

    By default, the ring is a disk.
    """
    rng = np.random.default_rng(seed)
    inner_share = (inner_radius / radius) ** 2
    relative_distance = np.sqrt(inner_share + (1.0 - inner_share) * rng.random(count))
    position = radius * relative_distance * np.exp(2j * np.pi * rng.random(count))
    return np.column_stack([position.real, position.imag, np.exp(rng.uniform(*np.log(forces), count))])
