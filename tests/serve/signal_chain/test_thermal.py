"""Tests of the estimate of warming on linear films with four electrodes, whose misfit has a closed form.

On a linear film, the charges of all contacts (F, Fx, Fy) fill three of the four dimensions. The misfit is the component
in the fourth dimension. On the biaxial film, equal charges of all electrodes are the charges of a contact, so that
warming cannot be distinguished from force. On the uniaxial film, whose electrodes differ, warming has a misfit.
"""

import numpy as np
import pytest

from isocharge.serve.signal_chain.thermal import Warming
from stage_runner import StageRunner

ANGLE = 2 * np.pi * np.arange(4) / 4

BIAXIAL = np.column_stack([np.ones(4), np.cos(ANGLE) / 20, np.sin(ANGLE) / 20])
"""Matrix from (F, Fx, Fy) to the charges of a biaxial film, shape (4, 3)."""

UNIAXIAL = np.array([1.6, 0.4, 1.6, 0.4])[:, None] * BIAXIAL
"""Matrix from (F, Fx, Fy) to the charges of a uniaxial film, shape (4, 3)."""

CONTACT = [850.0, 3.0, -2.0]
"""The contact (F, Fx, Fy) of a press."""

NOISE_pC = 2.0
"""Standard deviation of the noise by which the misfit is divided, pC."""


def misfit_of(film):
    """Return the misfit function of a film, which uses the unit vector orthogonal to the charges of all contacts."""
    direction = np.linalg.svd(film)[0][:, 3]
    return lambda charge_pC: np.abs(charge_pC @ direction) / NOISE_pC


def follow_warming(film, common_charges_pC):
    """Estimate a common charge that changes in steps of 50 ms during a press.

    Args:
        film: Matrix of the film.
        common_charges_pC: Common charge in each step, shape (n,), pC.

    Returns:
        The estimates, which are added to the tare, shape (n,), pC, and the flags of the last frame.
    """
    charges_pC = np.random.default_rng(0).normal(np.add.outer(common_charges_pC, film @ CONTACT), 0.5)
    chain = chain_in_contact(misfit_of(film))
    readings = [chain.advance(TARE_PC + charge_pC, 0.0, 0.05) for charge_pC in charges_pC]
    return np.array([reading.tare_pC[0] for reading in readings]) - TARE_PC[0], readings[-1].flags


def test_warming_of_half_a_kelvin_is_followed_unless_it_is_inseparable_from_force():
    """The film warms by 0.5 K, which is 135 pC on 9 mm^2, with the time constant of 25 um of PVDF in air, 2.7 s."""
    ramp = 135.0 * (1.0 - np.exp(-0.05 * np.arange(400) / 2.7))
    estimates, flags = follow_warming(UNIAXIAL, ramp)
    assert np.abs(estimates - ramp).max() < 15.0
    assert estimates[-50:] == pytest.approx(135.0, abs=5.0)
    assert flags == ("thermal",)

    estimates, flags = follow_warming(BIAXIAL, ramp)
    assert not estimates.any()
    assert flags == ("blind",)


def test_uncertainty_of_the_warming_grows_while_it_is_inseparable_from_force():
    """A blind time of 10 s. The first estimate after it removes nearly the whole warming of 18 pC."""
    film_misfit = misfit_of(BIAXIAL)
    chain = chain_in_contact(lambda charge_pC: film_misfit(charge_pC))
    for _ in range(200):
        assert advance(chain, 0.0).flags == ("blind",)
    film_misfit = misfit_of(UNIAXIAL)
    advance(chain, 18.0)
    assert warming_of(chain) == pytest.approx(18.0, rel=0.05)


PRESS = UNIAXIAL @ CONTACT
"""Touch charges of a press on the uniaxial film, shape (4,), pC."""

TARE_PC = np.full(4, 7.0)
"""Charges at rest, shape (4,), pC."""


def chain_in_contact(misfit=None, **sections):
    """Return a signal chain in the middle of a press, whose next frame of 50 ms contains an estimate of the warming."""
    chain = StageRunner(4, misfit or misfit_of(UNIAXIAL), tare={"frames": 2}, common_mode={"every_s": 0.05}, **sections)
    for _ in range(3):
        chain.advance(TARE_PC, 0.0, 1e-6)
    for dt_s in (1e-6, 0.01, 0.01):
        chain.advance(TARE_PC + PRESS, 0.0, dt_s)
    return chain


def advance(chain, common_pC, *, limited=False):
    """Process a frame of the press with a common charge on each electrode. The frame contains an estimate."""
    return chain.advance(PRESS + common_pC + TARE_PC, 0.0, 0.05, limited=limited)


def warming_of(chain):
    """Return the estimated common charge, pC."""
    return chain.stage(Warming)._charge_pC


@pytest.mark.parametrize("leak", [{}, {"leak": {"tau_s": 1e9}}])
def test_reading_is_corrected_in_the_frame_of_the_estimate(leak):
    """Without a leak, the warming is added to the tare, so that raw charge, tare and touch charge are consistent."""
    chain = chain_in_contact(**leak)
    reading = advance(chain, 15.0)
    warming_pC = warming_of(chain)
    assert warming_pC == pytest.approx(15.0, abs=3.0)
    np.testing.assert_allclose(reading.charge_pC, PRESS + 15.0 - warming_pC, atol=0.01)
    np.testing.assert_allclose(reading.tare_pC, TARE_PC if leak else reading.raw_pC - reading.charge_pC)

    # The next frame comes before the next estimate. The warming is not subtracted twice.
    next_reading = chain.advance(PRESS + 15.0 + TARE_PC, 0.0, 0.001)
    assert warming_of(chain) == warming_pC
    assert next_reading.charge_pC == pytest.approx(reading.charge_pC, abs=0.01)


def test_large_warming_is_flagged_and_a_clipped_charge_changes_no_warming():
    chain = chain_in_contact()
    reading = advance(chain, 15.0, limited=True)
    assert (reading.flags, warming_of(chain)) == (("saturated",), 0.0)
    np.testing.assert_allclose(reading.tare_pC, TARE_PC, atol=1.0)

    chain = chain_in_contact()
    for _ in range(5):
        reading = advance(chain, 30.0)
    assert reading.flags == ("thermal",)


def test_touch_begins_without_warming_and_the_correction_stays():
    chain = chain_in_contact()
    tare_pC = advance(chain, 15.0).tare_pC
    released = chain.advance(tare_pC, 0.0, 0.005)
    assert (released.is_contact, warming_of(chain)) == (False, 0.0)
    np.testing.assert_array_equal(released.charge_pC, np.zeros(4))
