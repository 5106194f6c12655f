"""Random contacts."""

import numpy as np


def draw_contacts(seed, count, radius, forces):
    """Draw contacts that are uniform over a disk and over the logarithm of the force, shape (count, 3), mm and N."""
    rng = np.random.default_rng(seed)
    position = radius * np.sqrt(rng.random(count)) * np.exp(2j * np.pi * rng.random(count))
    return np.column_stack([position.real, position.imag, np.exp(rng.uniform(*np.log(forces), count))])
