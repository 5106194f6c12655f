"""Tests of the memory correction with simulated films.

The films creep, cool and warm by laws in closed form, or by filters of scipy. The corrected charges are compared with
the touch charges from which the simulated charges were computed.
"""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.signal import lfilter

from isocharge.serve import Chunk, Contact, Frame, TouchStream, device_from_table, encode_frame
from isocharge.serve.signal_chain.memory import CREEP_LAW_DEVIATION, LEARN_S, WARMTH_CHANGE_PC
from isocharge.serve.signal_chain.memory_state import DECADES_S
from stage_runner import StageRunner

RATE_HZ = 200.0
"""Number of frames per second, Hz."""

CREEP = 0.08
"""Share of a charge that creep removes in each decade of time."""

STEP = 0.06
"""Size of the thermoelastic step, relative to the charge."""

WARMTH_S = 2.5
"""Time constant with which the film follows the temperature of the air, s."""

MEMORY = {"memory": {"creep": CREEP, "thermoelastic": STEP}}
"""Section of the device file with the right memory of the film."""

PRESS_pC = np.array([500.0, 400.0, 600.0])
"""Touch charges of a press, shape (n_electrode,), pC."""

NAMES = ("A", "B", "C")


def frame_times(seconds):
    """Return the times of the frames of a simulation, s."""
    return np.arange(round(seconds * RATE_HZ)) / RATE_HZ


def step_response(t):
    """Return the charge of the film at times t after a step of the touch charge by 1, s; 0 before the step."""
    held = 1.0 - CREEP * np.log10(np.maximum(t, 2e-3)) + STEP * np.exp(-np.maximum(t, 0.0) / WARMTH_S)
    return np.where(t > -1e-9, held, 0.0)


def film_response(t, *presses):
    """Return the charge of the film for presses (begin, end), s, with a touch charge of 1, shape (n,)."""
    return sum(step_response(t - begin) - step_response(t - end) for begin, end in presses)


def decay_of(time_constant_s):
    """Return the factor by which an exponential decays from frame to frame."""
    return np.exp(-1.0 / (RATE_HZ * time_constant_s))


def amplifier_output(film_charge, tau_s):
    """Return the output of an amplifier with the time constant tau_s for the charges of a film, shape (n, ...)."""
    return lfilter([1.0, -1.0], [1.0, -decay_of(tau_s)], film_charge, axis=0)


class ChainResult(NamedTuple):
    """Results of a signal chain for n frames.

    Attributes:
        charge_pC: Touch charges, shape (n, n_electrode), pC; 0 before the tare.
        contact: Whether something touches, shape (n,).
        scale_std: Relative standard deviation that all touch charges have in common, shape (n,).
    """

    charge_pC: np.ndarray
    contact: np.ndarray
    scale_std: np.ndarray


def run_chain(charge_pC, table=MEMORY, noise_pC=0.3, misfit=None):
    """Process charges by a signal chain.

    Args:
        charge_pC: Charges without noise, shape (n, n_electrode), pC.
        table: Sections of the device file.
        noise_pC: Standard deviation of the noise that is added, pC.
        misfit: Misfit of a model.
    """
    n_electrode = charge_pC.shape[1]
    rng = np.random.default_rng(0)
    noisy_pC = charge_pC + noise_pC * rng.standard_normal(charge_pC.shape)
    chain = StageRunner(n_electrode, misfit, **table)
    readings = [chain.advance(row, number / RATE_HZ, 1.0 / RATE_HZ) for number, row in enumerate(noisy_pC)]
    charges = [np.zeros(n_electrode) if reading.charge_pC is None else reading.charge_pC for reading in readings]
    return ChainResult(
        charge_pC=np.array(charges),
        contact=np.array([reading.is_contact for reading in readings]),
        scale_std=np.array([reading.charge_scale_std for reading in readings]),
    )


def is_within(t, begin, end):
    """Return whether times lie in an interval, shape (n,)."""
    return (t >= begin) & (t < end)


@pytest.mark.parametrize("tau_s", [None, 10.0])
def test_memory_of_the_prony_series_is_removed_exactly(tau_s):
    """Filters of scipy compute the charge of the film and the output of the amplifier.

    The touch charge varies during the press, and is 0 for 50 ms.
    """
    t = frame_times(30.0)
    touch = (is_within(t, 5.0, 20.0) | is_within(t, 20.05, 25.0)) * (1.0 + 0.3 * np.sin(t))
    touch_steps = np.diff(touch, prepend=0.0)
    creep_after_1_s = CREEP * np.exp(-1.0 / DECADES_S).sum()
    film_charge = (1.0 - creep_after_1_s) * touch
    for time_constant_s in DECADES_S:
        film_charge = film_charge + lfilter([CREEP], [1.0, -decay_of(time_constant_s)], touch_steps)
    film_charge = film_charge + lfilter([STEP], [1.0, -decay_of(WARMTH_S)], touch_steps)

    table = MEMORY
    output = film_charge
    if tau_s is not None:
        table = MEMORY | {"leak": {"tau_s": tau_s}}
        output = amplifier_output(film_charge, tau_s)
    result = run_chain(np.outer(output, PRESS_pC), table, noise_pC=0.0)
    np.testing.assert_allclose(result.charge_pC, np.outer(touch, PRESS_pC), atol=1e-6)
    np.testing.assert_array_equal(result.contact, touch > 0.0)


def test_a_minute_of_creep_and_cooling_leaves_half_a_percent():
    t = frame_times(95.0)
    charge = film_response(t, (5.0, 65.0), (75.0, 85.0))
    result = run_chain(np.outer(charge, PRESS_pC))
    np.testing.assert_array_equal(result.contact, is_within(t, 5.0, 65.0) | is_within(t, 75.0, 85.0))
    is_settled = is_within(t, 5.02, 65.0) | is_within(t, 75.02, 85.0)
    assert np.abs(result.charge_pC[is_settled] / PRESS_pC - 1.0).max() < 0.007
    charge_before_release = charge[round(64.9 * RATE_HZ)]
    assert charge_before_release < 1.0 - 0.13


@pytest.mark.parametrize("scale_errors", [(0.8, 0.8), (1.2, 1.2), (0.8, 1.2), (1.2, 0.8)])
def test_creep_known_to_20_percent_is_learned_from_the_first_release(scale_errors):
    creep_error, step_error = scale_errors
    t = frame_times(105.0)
    charge_pC = np.outer(film_response(t, (5.0, 65.0), (75.0, 100.0)), PRESS_pC)
    result = run_chain(charge_pC, {"memory": {"creep": CREEP * creep_error, "thermoelastic": STEP * step_error}})
    np.testing.assert_array_equal(result.contact, is_within(t, 5.0, 65.0) | is_within(t, 75.0, 100.0))

    error = np.abs(result.charge_pC / PRESS_pC - 1.0).max(axis=1)
    first_press = is_within(t, 5.1, 64.9)
    second_press = is_within(t, 75.1, 99.9)
    assert 0.02 < error[first_press].max() < 0.05
    assert error[second_press].max() < 0.016
    is_held = first_press | second_press
    assert np.all(error[is_held] < 2.0 * result.scale_std[is_held] + 0.007)
    expected_std = scale_std_of_second_press(np.array(scale_errors), t[second_press] - 75.0)
    np.testing.assert_allclose(result.scale_std[second_press], expected_std, rtol=0.08)


def scale_std_of_second_press(scale_errors, since_touch_s):
    """Compute the expected relative standard deviation of the charges of the second press by Bayes' theorem.

    The scale factors of creep and step are estimated at once from all frames after the first press, which was held for
    60 s and released 10 s before the second press.

    Args:
        scale_errors: Assumed creep and step, relative to the true values, shape (2,).
        since_touch_s: Times since the beginning of the second press, shape (n,), s.
    """
    held_s = 60.0

    def remaining_charge(since_release_s):
        """Return the charges that a creep of 1 and a step of 1 leave after the first press, shape (n, 2)."""
        creep = np.log10(1.0 + held_s / since_release_s)
        step = np.exp(-since_release_s / WARMTH_S) - np.exp(-(since_release_s + held_s) / WARMTH_S)
        return np.column_stack([creep, step])

    rest_s = np.arange(0.5, LEARN_S, 1.0 / RATE_HZ)
    assumed = np.array([CREEP, STEP]) * scale_errors
    remaining_pC = np.linalg.norm(PRESS_pC) * assumed * remaining_charge(rest_s)
    warmth_pC2 = PRESS_pC.size * WARMTH_CHANGE_PC**2 * (held_s + rest_s)
    law_pC2 = (CREEP_LAW_DEVIATION * remaining_pC.sum(axis=1)) ** 2
    precision = 1.0 / (warmth_pC2 + law_pC2)
    information = np.einsum("ni,nj,n->ij", remaining_pC, remaining_pC, precision) / (RATE_HZ * LEARN_S)
    covariance = np.linalg.inv(np.eye(2) / 0.2**2 + information)
    estimated = assumed * (1.0 + covariance @ information @ (1.0 / scale_errors - 1.0))

    second_press = np.column_stack([-np.log10(since_touch_s), np.exp(-since_touch_s / WARMTH_S)])
    sensitivity = (second_press - remaining_charge(since_touch_s + 10.0)) * estimated
    return np.sqrt(np.einsum("ni,ij,nj->n", sensitivity, covariance, sensitivity))


def test_hand_over_the_film_is_no_touch_and_does_not_change_a_press():
    """A hand warms the air by 2 K from 10 s to 35 s. The film follows the air by Newton's law of cooling.

    The electrodes have different pyroelectric charges, and one of them has the other sign. The charge of A changes by
    up to 420 pC, which is 84 % of its touch charge.
    """
    t = frame_times(50.0)
    charge_pC_per_K = np.array([-270.0, -200.0, 120.0])
    air_K = 2.0 * np.clip(np.minimum(t - 10.0, 35.0 - t), 0.0, 1.0)
    film_K = lfilter([1.0 - decay_of(WARMTH_S)], [1.0, -decay_of(WARMTH_S)], air_K)
    warmth_pC = np.outer(film_K, charge_pC_per_K)
    assert not run_chain(warmth_pC).contact.any()
    assert run_chain(warmth_pC, {}).contact.any()

    result = run_chain(np.outer(film_response(t, (12.0, 22.0)), PRESS_pC) + warmth_pC)
    np.testing.assert_array_equal(result.contact, is_within(t, 12.0, 22.0))
    settled_pC = result.charge_pC[is_within(t, 12.02, 22.0)]
    assert np.abs(settled_pC / PRESS_pC - 1.0).max() < 0.02


def test_bias_is_learned_beside_creep_and_warmth():
    tau_s = 10.0
    t = frame_times(70.0)
    bias_pC_per_s = [1.0, -0.5, 0.7]
    film_pC = np.outer(film_response(t, (40.0, 60.0)), PRESS_pC) + np.outer(t, bias_pC_per_s)
    result = run_chain(amplifier_output(film_pC, tau_s), MEMORY | {"leak": {"tau_s": tau_s}})
    settled_pC = result.charge_pC[is_within(t, 40.1, 59.9)]
    assert np.abs(settled_pC / PRESS_pC - 1.0).max() < 0.012


def test_warmth_that_comes_during_a_press_is_taken_from_it_by_the_fourth_electrode():
    """The film warms from 15 s on. Without the correction, up to 40 % of a charge would be wrong.

    The film is linear. The charges of all contacts (F, Fx, Fy) fill three of the four dimensions, and the misfit is the
    component in the fourth dimension.
    """
    t = frame_times(40.0)
    angle = 2 * np.pi * np.arange(4) / 4
    sensitivity = np.array([1.6, 0.4, 1.6, 0.4])[:, None]
    film = sensitivity * np.column_stack([np.ones(4), np.cos(angle), np.sin(angle)])
    press_pC = film @ [600.0, 0.15, -0.1]
    fourth_dimension = np.linalg.svd(film)[0][:, 3]
    warmth_K = -np.expm1(-np.maximum(t - 15.0, 0.0) / 2.5)
    charge_pC_per_K = np.array([125.0, 80.0, 110.0, 85.0])
    charge_pC = np.outer(film_response(t, (10.0, 30.0)), press_pC) + np.outer(warmth_K, charge_pC_per_K)

    table = {"common_mode": {"pC_per_K": dict(zip("ABCD", charge_pC_per_K.tolist(), strict=True))}}
    result = run_chain(charge_pC, MEMORY | table, misfit=lambda q: np.abs(q @ fourth_dimension) / 2.0)
    settled_pC = result.charge_pC[is_within(t, 10.1, 29.9)]
    assert np.abs(settled_pC / press_pC - 1.0).max() < 0.02
    assert not result.contact[t > 30.5].any()


def test_uncertain_memory_increases_standard_deviations_and_correlations():
    """The covariance of the sum of two independent errors is the sum of their covariances."""
    contact = Contact(1.0, 2.0, 0.5, 0.1, 0.2, 0.01, 0.3, 0.5, -0.2, 0.1)
    shift = (0.05, -0.1, 0.03)

    def covariance_of(contact):
        stds = [contact.x_std_mm, contact.y_std_mm, contact.force_std_N]
        correlation = np.array(
            [
                [1.0, contact.xy_correlation, contact.xF_correlation],
                [contact.xy_correlation, 1.0, contact.yF_correlation],
                [contact.xF_correlation, contact.yF_correlation, 1.0],
            ]
        )
        return np.outer(stds, stds) * correlation

    expected = covariance_of(contact) + np.outer(shift, shift)
    np.testing.assert_allclose(covariance_of(contact.widened(shift)), expected, rtol=1e-12)


def test_records_have_the_standard_deviations_of_an_uncertain_memory(film, predictor):
    """Creep and step are known to 20 %, so that all charges have a common relative error.

    Record 30 is 0.1 s after the touch, which is one decade before 1 s, so that the creep has its full value.
    """
    press_pC = film.charge_pC(np.full(1, 2.0), np.full(1, -3.0), np.full(1, 0.5))[0]
    rows_pC = [*np.zeros((10, 3)), *np.outer(step_response(frame_times(1.0)), press_pC)]
    device = device_from_table(MEMORY | {"tare": {"frames": 10}, "track": {}}, "b")
    stream = TouchStream(predictor, device, now_ns=lambda: 0)
    records = []
    for number, row in enumerate(rows_pC):
        frame = Frame(number, 5000 * number, tuple(row))
        records += stream.feed(Chunk(encode_frame(frame), 5.0 + number / RATE_HZ, 0))

    record = records[30]
    charge_std = 0.2 * np.hypot(STEP * np.exp(-0.1 / WARMTH_S), CREEP)  # relative to the charges
    charges_pC = np.array(list(record.charge_pC.values()))
    exact = predictor.predict(charges_pC)
    larger = predictor.predict(charges_pC * (1.0 + 0.5 * charge_std))
    smaller = predictor.predict(charges_pC * (1.0 - 0.5 * charge_std))
    expected_std_N = np.hypot(exact.force_std_N, larger.force_N - smaller.force_N)
    assert record.force_std_N == pytest.approx(expected_std_N, rel=0.1)
    assert expected_std_N > 2.0 * exact.force_std_N
    assert record.tracked.force_std_N > 0.8 * expected_std_N
    # On the linear film, a common error of all charges does not change the position.
    assert (record.x_std_mm, record.y_std_mm) == pytest.approx((exact.x_std_mm, exact.y_std_mm))
