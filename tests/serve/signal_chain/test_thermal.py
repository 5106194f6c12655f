"""Warming against films on which the misfit has a closed form: charges that lie in a plane of contacts, or do not.

On a linear film the charges of all contacts (F, Fx, Fy) fill a space of three dimensions; the misfit is the distance
from it. On the biaxial film that space holds equal charges, and warming looks like force; on the uniaxial one, whose
electrodes differ, it does not.
"""

import numpy as np
import pytest
from scipy.linalg import expm

from isocharge.serve.signal_chain.chain import Chain, SignalChain
from isocharge.serve.signal_chain.tare import TareRule
from isocharge.serve.signal_chain.thermal import NO_DRIFT, ThermalDrift, ThermalRule, track_thermal_drift

ANGLE = 2 * np.pi * np.arange(4) / 4
ALIKE = np.column_stack([np.ones(4), np.cos(ANGLE) / 20, np.sin(ANGLE) / 20])
BIAXIAL, UNIAXIAL = ALIKE, np.array([1.6, 0.4, 1.6, 0.4])[:, None] * ALIKE


def misfit_of(film, sigma_pC=2.0):
    across = np.linalg.svd(film)[0][:, 3]
    return lambda charge_pC: np.abs(charge_pC @ across) / sigma_pC


def warmed(film, ramp_pC, seed=0):
    """The estimates of a common charge while it rises in steps of 50 ms, and the last state."""
    press, rng, state, estimates = film @ [850.0, 3.0, -2.0], np.random.default_rng(seed), NO_DRIFT, []
    for common_pC in ramp_pC:
        charge_pC = press + common_pC - state.charge_pC + rng.normal(0, 0.5, 4)
        state = track_thermal_drift(ThermalRule(), state, charge_pC, misfit_of(film), 0.05)
        estimates.append(state.charge_pC)
    return np.array(estimates), state


def test_warming_of_half_a_kelvin_is_followed():
    """As fast as 25 um of PVDF follow the air: 0.5 K, 135 pC on 9 mm^2, with a time constant of 2.7 s."""
    ramp = 135.0 * (1.0 - np.exp(-0.05 * np.arange(400) / 2.7))
    estimates, state = warmed(UNIAXIAL, ramp)
    assert np.abs(estimates - ramp).max() < 15.0
    assert estimates[-50:] == pytest.approx(135.0, abs=5.0)
    assert not state.blind


def test_warming_that_is_inseparable_from_force_is_not_subtracted():
    estimates, state = warmed(BIAXIAL, np.linspace(0, 135, 100))
    assert not estimates.any()
    assert state.blind


def test_charge_and_slope_are_estimated_by_a_kalman_filter():
    """Of a slope that decays and walks at random, so that the charge changes by `wander_pC` in a second, in matrices;
    the misfit weighs the sum of its direction's parts."""
    rule, t, warmth_s, off_pC = ThermalRule(), 0.4, 1e3, 4.0
    before, known = ThermalDrift(3.0, 40.0, covariance=5.0, rate_variance=20.0), np.array([[40.0, 5.0], [5.0, 20.0]])
    flow = expm(t * np.array([[0.0, 1.0], [0.0, -1.0 / warmth_s]]))
    walk = 3.0 * rule.wander_pC**2 * np.array([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]])
    predicted = flow @ known @ flow.T + walk
    across = np.linalg.svd(UNIAXIAL)[0][:, 3]
    gain = predicted[:, 0] / (predicted[0, 0] + (rule.noise * 2.0 / across.sum()) ** 2)
    after = track_thermal_drift(rule, before, PRESS + off_pC, misfit_of(UNIAXIAL), t, warmth_s=warmth_s)
    found = after.charge_pC - 3.0, after.rate_pC_per_s, after.variance_pC2, after.covariance, after.rate_variance
    posterior = predicted - np.outer(gain, predicted[0])
    assert found == pytest.approx([*off_pC * gain, posterior[0, 0], posterior[0, 1], posterior[1, 1]], rel=1e-3)


def test_misfit_is_evaluated_twenty_times_a_second():
    evaluated, state = [], NO_DRIFT
    for _ in range(1000):
        state = track_thermal_drift(
            ThermalRule(), state, np.ones(4), lambda q: evaluated.append(q) or np.ones(5), 0.001
        )
    assert 19 <= len(evaluated) <= 20


PRESS = UNIAXIAL @ [850.0, 3.0, -2.0]
TARE_PC = np.full(4, 7.0)


def in_contact(misfit=None, **settings):
    """A chain in the middle of a press, just before an estimate of the warming is due."""
    rule = ThermalRule(every_s=0.05)
    chain = SignalChain(Chain(tare=TareRule(frames=2), thermal=rule, **settings), 4, misfit or misfit_of(UNIAXIAL))
    for _ in range(3):
        chain.advance(TARE_PC, 0.0, 1e-6)
    for dt_s in (1e-6, 0.01, 0.01):
        chain.advance(TARE_PC + PRESS, 0.0, dt_s)
    return chain


def step(chain, common_pC, *, limited=False):
    """The next frame, in which an estimate is due: the press, and the same charge more on each electrode."""
    return chain.advance(PRESS + common_pC + TARE_PC, 0.0, 0.04, limited=limited)


def warming_of(chain):
    """The common charge that was estimated, pC."""
    return chain.stages[-1]._drift.charge_pC


def test_reading_is_corrected_in_the_frame_of_the_estimate():
    """Without a leak the tare takes it, so raw charge, tare and touch charge of one frame fit together."""
    chain = in_contact()
    reading = step(chain, 15.0)
    assert warming_of(chain) == pytest.approx(15.0, abs=3.0)
    np.testing.assert_allclose(reading.charge_pC, PRESS + 15.0 - warming_of(chain))
    np.testing.assert_allclose(reading.raw_pC - reading.tare.charge_pC, reading.charge_pC)
    before = warming_of(chain)
    again = chain.advance(PRESS + 15.0 + TARE_PC, 0.0, 0.001)  # no estimate is due, and none is subtracted twice
    assert warming_of(chain) == before
    assert again.charge_pC == pytest.approx(reading.charge_pC)


def test_correction_goes_into_the_leak_if_there_is_one():
    chain = in_contact(tau_s=np.full(4, 1e9))
    reading = step(chain, 15.0)
    np.testing.assert_allclose(reading.charge_pC, PRESS + 15.0 - warming_of(chain), atol=0.01)
    np.testing.assert_allclose(reading.tare.charge_pC, TARE_PC)
    assert warming_of(chain) == pytest.approx(15.0, abs=3.0)


def test_large_warming_is_flagged():
    chain = in_contact()
    for _ in range(5):
        reading = step(chain, 30.0)
    assert reading.flags == ("thermal",)


def test_clipped_charge_changes_no_warming():
    chain = in_contact()
    before = warming_of(chain)
    reading = step(chain, 15.0, limited=True)
    assert warming_of(chain) == before
    assert reading.flags == ("saturated",)
    np.testing.assert_allclose(reading.tare.charge_pC, TARE_PC, atol=1.0)


def test_touch_begins_without_warming_and_the_correction_stays():
    chain = in_contact()
    tare_pC = step(chain, 15.0).tare.charge_pC
    released = chain.advance(tare_pC, 0.0, 0.005)
    assert (released.contact, warming_of(chain)) == (False, 0.0)
    np.testing.assert_array_equal(released.charge_pC, np.zeros(4))


def test_stage_needs_a_misfit():
    with pytest.raises(ValueError, match="needs the misfit of a model, got None"):
        SignalChain(Chain(thermal=ThermalRule()), 4)
