"""Warming against films on which the misfit has a closed form: charges that lie in a plane of contacts, or do not.

On a linear film the charges of all contacts (F, Fx, Fy) fill a space of three dimensions; the misfit is the distance
from it. On the biaxial film that space holds equal charges, and warming looks like force; on the uniaxial one, whose
electrodes differ, it does not.
"""

import numpy as np
import pytest

from isocharge.serve.signal_chain.chain import ChainState
from isocharge.serve.signal_chain.leak import Leak
from isocharge.serve.signal_chain.tare import Tare
from isocharge.serve.signal_chain.thermal import NO_DRIFT, ThermalRule, track_thermal_drift

ANGLE = 2 * np.pi * np.arange(4) / 4
ALIKE = np.column_stack([np.ones(4), np.cos(ANGLE) / 20, np.sin(ANGLE) / 20])
BIAXIAL, UNIAXIAL = ALIKE, np.array([1.6, 0.4, 1.6, 0.4])[:, None] * ALIKE


def misfit_of(film, sigma_pC=2.0):
    across = np.linalg.svd(film)[0][:, 3]
    return lambda charge_pC: np.abs(charge_pC @ across) / sigma_pC


def warmed(film, ramp_pC, seed=0):
    """The common charge that is found while it rises in steps of 50 ms."""
    press, rng, state, found = film @ [850.0, 3.0, -2.0], np.random.default_rng(seed), NO_DRIFT, []
    for common_pC in ramp_pC:
        charge_pC = press + common_pC - state.charge_pC + rng.normal(0, 0.5, 4)
        state = track_thermal_drift(ThermalRule(), state, charge_pC, misfit_of(film), 0.05)
        found.append(state.charge_pC)
    return np.array(found), state


def test_a_step_of_half_a_kelvin_is_followed():
    ramp = np.concatenate([np.linspace(0, 135, 100), np.full(100, 135.0)])
    found, state = warmed(UNIAXIAL, ramp)
    assert np.abs(found - ramp).max() < 15.0
    assert found[-50:] == pytest.approx(135.0, abs=5.0)
    assert not state.blind


def test_where_it_cannot_be_told_nothing_is_taken():
    found, state = warmed(BIAXIAL, np.linspace(0, 135, 100))
    assert not found.any()
    assert state.blind


def test_a_quiet_film_stays_quiet():
    found, _ = warmed(UNIAXIAL, np.zeros(400))
    assert np.abs(found).max() < 5.0


def test_the_model_is_asked_twenty_times_a_second():
    asked, state = [], NO_DRIFT
    for _ in range(1000):
        state = track_thermal_drift(ThermalRule(), state, np.ones(4), lambda q: asked.append(q) or np.ones(5), 0.001)
    assert 19 <= len(asked) <= 20


def test_a_shift_goes_into_the_leak_or_into_the_tare():
    tare = Tare(np.full(4, 7.0), np.ones(4), 100)
    bare = ChainState(np.empty((0, 4)), None, tare=tare)
    np.testing.assert_array_equal(bare.shifted(3.0).tare.charge_pC, np.full(4, 10.0))
    leaky = ChainState(np.empty((0, 4)), None, tare=tare, leak=Leak.start(np.zeros(4)))
    np.testing.assert_array_equal(leaky.shifted(3.0).leak.charge_pC, np.full(4, -3.0))
    np.testing.assert_array_equal(leaky.shifted(3.0).tare.charge_pC, tare.charge_pC)
