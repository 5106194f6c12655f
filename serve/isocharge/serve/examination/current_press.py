"""Estimate of the leak of the integral of currents, from a press that is made and released during the port check.

After the release, the charges of an ideal film are those before the press. The integral of the currents misses this
value if the film leaks or the offset of the currents drifts. The leak is chosen so that the integral comes nearest.
"""

import numpy as np

from isocharge.common.arrays import Array
from isocharge.serve.examination.held_press import HeldPress
from isocharge.serve.examination.press_detector import BLOCK_S

MIN_REST_BLOCKS = 5
"""Smallest number of blocks at rest before and after the press."""

CURRENT_SIGMAS = 8.0
"""Mean current of a block that counts as a touch, in standard errors of the mean of the blocks at rest."""

TAU_S = np.append(np.geomspace(1000.0, 1.0, 121), np.inf)
"""Time constants of the leak that are compared, s. An infinite time constant is no leak."""

MAX_RESIDUAL_RATIO = 0.8
"""Largest residual with a leak, relative to the residual without a leak, for which a leak is proposed."""


def find_current_press(values: Array, times_s: Array) -> HeldPress | None:
    """Find a press that is made and released during the check, and estimate the leak of the integral of the currents.

    Args:
        values: Currents of the channels, shape (n, channels), in any unit.
        times_s: Times since the first frame, shape (n,), s.

    Returns:
        The press, with the section `[leak]` if a leak brings the charges nearer to rest; None if there is no press with
        half a second of rest before and after it.
    """
    n_block = int(times_s[-1] / BLOCK_S)
    if n_block < 2 * MIN_REST_BLOCKS or not np.isfinite(values).all():
        return None
    block = np.minimum((times_s / BLOCK_S).astype(int), n_block - 1)
    count = np.bincount(block, minlength=n_block)[:, None]
    is_rest = block < MIN_REST_BLOCKS
    current = values - values[is_rest].mean(axis=0)
    charge = np.stack([np.bincount(block, column, n_block) for column in current.T], axis=1)  # of each block
    noise = np.maximum(current[is_rest].std(axis=0), np.finfo(float).tiny)
    touched = np.flatnonzero((np.abs(charge) > CURRENT_SIGMAS * noise * np.sqrt(count)).any(axis=1))
    if touched.size == 0 or touched[0] < MIN_REST_BLOCKS or touched[-1] >= n_block - MIN_REST_BLOCKS:
        return None

    # All blocks before the press determine the offset better than the first blocks.
    charge -= count * charge[: touched[0]].sum(axis=0) / count[: touched[0]].sum()
    kept = np.exp(-BLOCK_S / TAU_S)[:, None]
    integral = np.zeros((len(TAU_S), charge.shape[1]))  # one for each time constant
    peak = 0.0
    for step in charge[touched[0] : touched[-1] + 1]:
        integral = kept * integral + step
        peak = max(peak, float(np.linalg.norm(integral[-1])))  # without a leak
    residual = np.linalg.norm(integral, axis=1)
    best = int(np.argmin(residual))
    begin_s = BLOCK_S * float(touched[0])
    remaining = f"{100.0 * residual[-1] / peak:.2g} % of the largest charge remains after the release"
    if residual[best] > MAX_RESIDUAL_RATIO * residual[-1]:
        return HeldPress(begin_s, {}, f"{remaining}, and no leak reduces it")
    tau_s = float(f"{TAU_S[best]:.3g}")
    description = f"{remaining}, and {100.0 * residual[best] / peak:.2g} % with [leak] tau_s = {tau_s:g}"
    return HeldPress(begin_s, {"leak": {"tau_s": tau_s}}, description)
