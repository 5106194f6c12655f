"""Arrays of small companion files of a model, such as `charges.npz`, `pretensions.npz` and `film_directions.npz`."""

import io

import numpy as np

from isocharge.serve.model.pretensions import Pretensions

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
        "pretension_MPa": np.array(0.8),
        "tension_std_MPa": np.array(0.1),
    }


def direction_arrays():
    """The arrays of a small `film_directions.npz` with two directions and four electrodes."""
    series = np.zeros((2, 2, 2, 2, 4))
    series[0, 0, 0, 0] = 0.01
    series[1, 0, 0, 1] = [0.02, -0.02, 0.01, 0.0]
    return {
        "series": series,
        "radius_mm": np.array(8.0),
        "force_N": np.array([0.05, 2.0]),
        "by_pretension": np.array([0.1, -0.2]),
    }


def film_charge_arrays():
    """The arrays of a small `film_charges.npz` with four electrodes, whose charges fall as the pretension rises.

    The position moves charge between opposite electrodes, and the force scales all charges equally.
    """
    log_charge = np.zeros((2, 2, 2, 4))
    log_charge[0, 0, 0] = np.log(200.0)
    log_charge[1, 0, 0] = [0.1, 0.0, -0.1, 0.0]  # of x
    log_charge[0, 1, 0] = [0.0, 0.1, 0.0, -0.1]  # of y
    log_charge[0, 0, 1] = 0.7  # of the force
    log_change_per_MPa = np.zeros_like(log_charge)
    log_change_per_MPa[0, 0, 0] = [-0.5, -0.4, -0.5, -0.4]
    node_MPa = np.array([0.5, 1.0, 2.0])
    return {
        "series": log_charge + node_MPa[:, None, None, None, None] * log_change_per_MPa,
        "node_MPa": node_MPa,
        "radius_mm": np.array(8.0),
        "force_N": np.array([0.05, 2.0]),
    }


def pretension_arrays():
    """The arrays of a small network at three pretensions."""
    rng = np.random.default_rng(0)
    weights = {
        "w0": rng.normal(size=(3, 4, 5)),
        "b0": rng.normal(size=(3, 5)),
        "skip": rng.normal(size=(3, 4, 7)),
        "bias": rng.normal(size=(3, 7)),
        "last": rng.normal(size=(3, 5, 7)),
    }
    pretensions = Pretensions(
        node_MPa=np.array([0.2, 0.8, 1.4]),
        calibrated_MPa=0.8,
        std_MPa=0.1,
        floor_MPa=0.01,
        misfit_rms=1.0,
        misfit_unit=1.0,
        limits_pC=(1.0, 1e5),
        typical_pC=np.array([500.0, 400.0, 300.0, 200.0]),
        weights={name: value.astype(np.float32) for name, value in weights.items()},
    )
    with np.load(io.BytesIO(pretensions.to_bytes())) as file:
        return dict(file)
