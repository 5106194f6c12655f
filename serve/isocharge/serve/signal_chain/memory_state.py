"""State that the module `memory` uses to describe the memory of a film.

This module defines the rows of the state, the properties of a film, and the propagation of the state in time.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array

DECADES_S = 10.0 ** np.arange(-3, 5)
"""Time constants of the creep terms, s. The sum of the terms approximates creep from 1 ms to some minutes."""

WARMTH_ROW = -3
SLOPE_ROW = -2
CHARGE_ROW = -1
"""Rows of the warmth d, of its slope and of the touch charge q in the state.

The first rows of the state are the creep terms and the thermoelastic term.
"""

WARMTH_ROWS = slice(WARMTH_ROW, CHARGE_ROW)
"""Rows of the warmth and of its slope."""

INITIAL_PROPAGATION = np.diag([*np.ones(len(DECADES_S) + 3), 0.0])
"""Propagation of the state over a time of 0, shape (rows, rows).

The row of the touch charge is 0, because the touch charge of the next frame is not known yet.
"""

CREEP_RESPONSE = np.array([*-np.ones(len(DECADES_S)), 0.0, 0.0, 0.0, -np.expm1(-1.0 / DECADES_S).sum()])
"""Contribution of each row of the state to the charge of a film with `creep = 1`, shape (rows,)."""

STEP_RESPONSE = np.array([*np.zeros(len(DECADES_S)), -1.0, 0.0, 0.0, 1.0])
"""Contribution of each row of the state to the charge of a film with `thermoelastic = 1`, shape (rows,)."""

SCALE_RESPONSE = np.stack([CREEP_RESPONSE, STEP_RESPONSE])
"""`CREEP_RESPONSE` and `STEP_RESPONSE` in one matrix, shape (2, rows)."""


class ScaleVariances(NamedTuple):
    """Variances of the scale factors of creep and thermoelastic step, and their covariance, dimensionless."""

    creep: float
    step: float
    covariance: float


class Film(NamedTuple):
    """Properties of a film.

    Attributes:
        creep: Estimated share of a charge that is lost in each decade of time.
        thermoelastic: Estimated share by which the charges of a touch are larger at first.
        response: Contribution of each row of the state to the charge of the film, shape (rows,), dimensionless.
        step_response: Charge of the film directly after a step of the touch charge by 1; h(0) in the module docstring.
        variances: Variances of the scale factors of creep and step.
    """

    creep: float
    thermoelastic: float
    response: Array
    step_response: float
    variances: ScaleVariances

    @classmethod
    def with_memory(cls, creep: float, thermoelastic: float, variances: ScaleVariances) -> "Film":
        """Return the properties of a film with a given creep and thermoelastic step.

        The rows of the state are the creep terms, the thermoelastic term, the warmth (charge due to a change of
        temperature), the slope of the warmth, and the touch charge. The charge of the film is the sum of all rows, each
        multiplied by its response.

        Args:
            creep: Share of a charge that is lost in each decade of time.
            thermoelastic: Share by which the charges of a touch are larger at first.
            variances: Variances of the scale factors of creep and step.
        """
        # The charge of the film is the sum of the warmth, the touch charge, and the charges of creep and of the
        # thermoelastic step.
        response = creep * CREEP_RESPONSE + thermoelastic * STEP_RESPONSE
        response[WARMTH_ROW] = 1.0
        response[CHARGE_ROW] += 1.0
        step_response = float(response[CHARGE_ROW])  # a step of the touch charge does not change other rows at once
        return cls(creep, thermoelastic, response, step_response, variances)


@lru_cache(maxsize=8)
def _relaxation(warmth_s: float) -> tuple[Array, Array]:
    """Return the time constants and the steady state from which `state_propagation` computes its matrix.

    The rows of the state are the creep terms, the thermoelastic term, the warmth (charge due to a change of
    temperature), its slope, and the touch charge.

    Args:
        warmth_s: Time constant with which the film follows the temperature of the air, s.

    Returns:
        Two arrays. The first array is the time constant of each row, shape (rows, 1), s. The second array is the matrix
        that propagates the state over a very long time, shape (rows, rows). After such a time, the creep terms and the
        thermoelastic term equal the touch charge. The slope of the warmth has decayed to zero, and has changed the
        warmth by `warmth_s` multiplied by the slope.
    """
    steady_state = np.zeros_like(INITIAL_PROPAGATION)
    steady_state[:WARMTH_ROW, CHARGE_ROW] = 1.0  # the creep terms and the thermoelastic term follow the touch charge
    steady_state[WARMTH_ROW, WARMTH_ROW] = 1.0
    steady_state[WARMTH_ROW, SLOPE_ROW] = warmth_s
    # The thermoelastic term, the warmth and its slope follow the temperature of the air. The time constant of the last
    # row, the touch charge, has no effect, because this row is 0 at the time 0 and in the steady state.
    time_constants_s = np.array([*DECADES_S, warmth_s, warmth_s, warmth_s, warmth_s])
    return time_constants_s[:, np.newaxis], steady_state


@lru_cache(maxsize=256)
def state_propagation(warmth_s: float, dt_s: float) -> Array:
    """Return the matrix that advances the state by a given time, shape (rows, rows).

    Let I be the matrix for the time 0, S the matrix for a very long time, and tau the time constant of a row. The
    matrix for the time dt is S + exp(-dt / tau) (I - S).

    Args:
        warmth_s: Time constant with which the film follows the temperature of the air, s.
        dt_s: The time, s.
    """
    time_constants_s, steady_state = _relaxation(warmth_s)
    decay = np.exp(-dt_s / time_constants_s)
    return np.asarray(steady_state + decay * (INITIAL_PROPAGATION - steady_state))
