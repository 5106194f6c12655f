"""Arrays of a small `charges.npz`."""

import numpy as np

ELECTRODES = ("A", "B", "C", "D")
"""Names of the electrodes."""


def charge_arrays():
    """The arrays of a small `charges.npz` with two directions, whose charges fall as the pretension rises.

    The position moves charge between opposite electrodes, and the force scales all charges equally.
    """
    log_charge = np.zeros((2, 2, 2, 4))
    log_charge[0, 0, 0] = np.log(200.0)
    log_charge[1, 0, 0] = [0.1, 0.0, -0.1, 0.0]  # of x
    log_charge[0, 1, 0] = [0.0, 0.1, 0.0, -0.1]  # of y
    log_charge[0, 0, 1] = 0.7  # of the force
    log_change_per_MPa = np.zeros_like(log_charge)
    log_change_per_MPa[0, 0, 0] = [-0.5, -0.4, -0.5, -0.4]
    node_MPa = np.array([-0.5, 0.0, 1.0])
    directions = np.zeros((2, 2, 2, 2, 4))
    directions[0, 0, 0, 0] = 0.01
    directions[1, 0, 0, 1] = [0.02, -0.02, 0.01, 0.0]
    return {
        "format": np.array(2),
        "series": log_charge + node_MPa[:, None, None, None, None] * log_change_per_MPa,
        "node_MPa": node_MPa,
        "directions": directions,
        "radius_mm": np.array(8.0),
        "force_N": np.array([0.05, 2.0]),
        "is_folded": np.array(0),
        "charge_std": np.array(0.003),
        "offset_pC": np.array(3.0),
        "pretension_MPa": np.array(0.8),
        "tension_std_MPa": np.array(0.1),
    }
