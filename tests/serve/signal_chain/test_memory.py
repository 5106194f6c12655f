"""The film's memory undone: against filters of scipy, the logarithm itself, and a law of cooling."""

from functools import partial

import numpy as np
import pytest
from scipy.signal import lfilter

from isocharge.common.errors import DeviceError
from isocharge.serve import Chunk, Contact, Frame, TouchStream, device_from_table, encode_frame
from isocharge.serve.prediction.contact import Sensitivity
from isocharge.serve.signal_chain.chain import SignalChain
from isocharge.serve.signal_chain.memory import CREEP_LAW_DEVIATION, DECADES_S, LEARN_S, WARMTH_CHANGE_PC
from isocharge.train.export_c.folder import device_header

RATE_HZ, CREEP, STEP, WARMTH_S = 200.0, 0.08, 0.06, 2.5
MEMORY = {"memory": {"creep": CREEP, "thermoelastic": STEP}}
SHAPE = np.array([500.0, 400.0, 600.0])
NAMES = ("A", "B", "C")


def times(seconds):
    return np.arange(round(seconds * RATE_HZ)) / RATE_HZ


def law(t):
    """What a film shows of a charge, t s after it; 0 before."""
    held = 1.0 - CREEP * np.log10(np.maximum(t, 2e-3)) + STEP * np.exp(-np.maximum(t, 0.0) / WARMTH_S)
    return np.where(t > -1e-9, held, 0.0)


def shown(t, *presses):
    """Superposed steps of presses (begin s, end s) of 1, shape (n,)."""
    return sum(law(t - begin) - law(t - end) for begin, end in presses)


def undo(charge_pC, table=MEMORY, noise_pC=0.3, misfit=None):
    """Touch charges (n, m), contact (n,) and doubt (n,) of charges (n, m), pC."""
    count, rng = charge_pC.shape[1], np.random.default_rng(0)
    chain = SignalChain(device_from_table(table, "b").chain(tuple("ABCD"[:count])), count, misfit)
    readings = []
    for k, row in enumerate(charge_pC + noise_pC * rng.standard_normal(charge_pC.shape)):
        readings.append(chain.advance(row, k / RATE_HZ, 1.0 / RATE_HZ))
    charges = [np.zeros(count) if reading.charge_pC is None else reading.charge_pC for reading in readings]
    return np.array(charges), *np.array([(reading.contact, reading.charge_scale_std) for reading in readings]).T


def pressed(t, begin, end):
    return (t >= begin) & (t < end)


@pytest.mark.parametrize("tau_s", [None, 10.0])
def test_memory_of_the_prony_series_is_removed_exactly(tau_s):
    """Filters of scipy make what film and leaky amplifier show of a charge that varies and is let go for a moment."""
    t = times(30.0)
    touch = (pressed(t, 5.0, 20.0) | pressed(t, 20.05, 25.0)) * (1.0 + 0.3 * np.sin(t))
    steps, crept = np.diff(touch, prepend=0.0), CREEP * np.exp(-1.0 / DECADES_S).sum()
    film = (1.0 - crept) * touch
    for lag, weight in zip([*DECADES_S, WARMTH_S], [CREEP] * len(DECADES_S) + [STEP], strict=True):
        film = film + lfilter([weight], [1.0, -np.exp(-1.0 / (RATE_HZ * lag))], steps)
    leak = {} if tau_s is None else {"leak": {"tau_s": tau_s}}
    if tau_s is not None:
        film = lfilter([1.0, -1.0], [1.0, -np.exp(-1.0 / (RATE_HZ * tau_s))], film)
    got, contact, _ = undo(np.outer(film, SHAPE), MEMORY | leak, noise_pC=0.0)
    np.testing.assert_allclose(got, np.outer(touch, SHAPE), atol=1e-6)
    np.testing.assert_array_equal(contact, touch > 0.0)


def test_a_minute_of_creep_and_cooling_leaves_half_a_percent():
    t = times(95.0)
    got, contact, _ = undo(np.outer(shown(t, (5.0, 65.0), (75.0, 85.0)), SHAPE))
    np.testing.assert_array_equal(contact, pressed(t, 5.0, 65.0) | pressed(t, 75.0, 85.0))
    after_s = np.where(t < 65.0, t - 5.0, t - 75.0)[contact > 0]
    assert np.abs(got[contact > 0][after_s > 0.02] / SHAPE - 1.0).max() < 0.007
    assert np.abs(np.outer(shown(t, (5.0, 65.0)), SHAPE)[13_000 - 20] / SHAPE - 1.0).min() > 0.13  # what is undone


@pytest.mark.parametrize("wrong", [(0.8, 0.8), (1.2, 1.2), (0.8, 1.2), (1.2, 0.8)])
def test_creep_known_to_20_percent_is_learned_from_the_first_release(wrong):
    t = times(105.0)
    table = {"memory": {"creep": CREEP * wrong[0], "thermoelastic": STEP * wrong[1]}}
    got, contact, doubt = undo(np.outer(shown(t, (5.0, 65.0), (75.0, 100.0)), SHAPE), table)
    error = np.abs(got / SHAPE - 1.0).max(axis=1)
    first, second = pressed(t, 5.1, 64.9), pressed(t, 75.1, 99.9)
    np.testing.assert_array_equal(contact, pressed(t, 5.0, 65.0) | pressed(t, 75.0, 100.0))
    for held, least, most in ((first, 0.02, 0.05), (second, 0.0, 0.016)):
        assert least < error[held].max() < most
        assert np.all(error[held] < 2.0 * doubt[held] + 0.007)
    np.testing.assert_allclose(doubt[second], bayes(np.array(wrong), t[second] - 75.0), rtol=0.08)


def bayes(wrong, after_s):
    """Doubt of a second press, after_s in it: scales of creep and step given all that 60 s left on the film at once."""

    def less(later_s, before_s):
        """What is seen less of each, in charges of 1, once held for before_s and released, and after it."""
        gone = np.exp(-later_s / WARMTH_S) - np.exp(-(later_s + before_s) / WARMTH_S)
        return np.column_stack([np.log10(1.0 + before_s / later_s), gone])

    rest_s = np.arange(0.5, LEARN_S, 1.0 / RATE_HZ)
    scales = np.array([CREEP, STEP]) * wrong
    left_pC = np.linalg.norm(SHAPE) * scales * less(rest_s, 60.0)
    noise_pC2 = SHAPE.size * WARMTH_CHANGE_PC**2 * (60.0 + rest_s) + (CREEP_LAW_DEVIATION * left_pC.sum(axis=1)) ** 2
    information = np.einsum("ni,nj,n->ij", left_pC, left_pC, 1.0 / noise_pC2) / (RATE_HZ * LEARN_S)
    covariance = np.linalg.inv(np.eye(2) / 0.2**2 + information)
    scales = scales * (1.0 + covariance @ information @ (1.0 / wrong - 1.0))
    held = np.column_stack([-np.log10(after_s), np.exp(-after_s / WARMTH_S)]) - less(after_s + 10.0, 60.0)
    return np.sqrt(np.einsum("ni,ij,nj->n", held * scales, covariance, held * scales))


def test_hand_over_the_film_is_no_touch_and_does_not_change_a_press():
    """Newton's law of cooling: 2 K, which come and go within a second; electrodes unalike, one of the other sign."""
    t, per_K = times(50.0), np.array([-270.0, -200.0, 120.0])
    air = 2.0 * np.clip(np.minimum(t - 10.0, 35.0 - t), 0.0, 1.0)
    warm = np.outer(
        lfilter([1.0 - np.exp(-1.0 / (RATE_HZ * WARMTH_S))], [1.0, -np.exp(-1.0 / (RATE_HZ * WARMTH_S))], air), per_K
    )
    assert not undo(warm)[1].any()
    got, contact, _ = undo(np.outer(shown(t, (12.0, 22.0)), SHAPE) + warm)
    np.testing.assert_array_equal(contact, pressed(t, 12.0, 22.0))
    assert np.abs(got[pressed(t, 12.02, 22.0)] / SHAPE - 1.0).max() < 0.02  # 420 pC are 84 % of A's charge
    assert undo(warm, {})[1].any()


def test_bias_is_learned_beside_creep_and_warmth():
    t = times(70.0)
    film = np.outer(shown(t, (40.0, 60.0)), SHAPE) + np.outer(t, [1.0, -0.5, 0.7])
    output = lfilter([1.0, -1.0], [1.0, -np.exp(-1.0 / (RATE_HZ * 10.0))], film, axis=0)
    got, _, _ = undo(output, MEMORY | {"leak": {"tau_s": 10.0}})
    assert np.abs(got[pressed(t, 40.1, 59.9)] / SHAPE - 1.0).max() < 0.012


def test_warmth_that_comes_during_a_press_is_taken_from_it_by_the_fourth_electrode():
    """Charges of all contacts (F, Fx, Fy) fill three dimensions; uncorrected, up to 40 % of a charge would be wrong."""
    angle, t = 2 * np.pi * np.arange(4) / 4, times(40.0)
    film = np.array([1.6, 0.4, 1.6, 0.4])[:, None] * np.column_stack([np.ones(4), np.cos(angle), np.sin(angle)])
    press, across = film @ [600.0, 0.15, -0.1], np.linalg.svd(film)[0][:, 3]
    warmth, per_K = -np.expm1(-np.maximum(t - 15.0, 0.0) / 2.5), np.array([125.0, 80.0, 110.0, 85.0])
    table = {"common_mode": {"pC_per_K": dict(zip("ABCD", per_K.tolist(), strict=True))}}
    charge_pC = np.outer(shown(t, (10.0, 30.0)), press) + np.outer(warmth, per_K)
    got, contact, _ = undo(charge_pC, MEMORY | table, misfit=lambda q: np.abs(q @ across) / 2.0)
    assert np.abs(got[pressed(t, 10.1, 29.9)] / press - 1.0).max() < 0.02
    assert not contact[t > 30.5].any()


def test_uncertain_memory_increases_standard_deviations_and_correlations():
    """The covariance of two independent errors is the sum of theirs."""
    one = Contact(1.0, 2.0, 0.5, 0.1, 0.2, 0.01, 0.3, 0.5, -0.2, 0.1)
    shift = np.array([0.05, -0.1, 0.03])

    def covariance(contact):
        xy, xF, yF = contact[7:]
        return np.outer(contact[3:6], contact[3:6]) * [[1, xy, xF], [xy, 1, yF], [xF, yF, 1]]

    expected = covariance(one) + np.outer(shift, shift)
    np.testing.assert_allclose(covariance(one.widened(tuple(shift.tolist()))), expected, rtol=1e-12)


@pytest.mark.parametrize(
    ("moved", "again"),
    [((0.2, -0.2, 0.02), 0.0), ((0.4, 0.0, 0.0), 1.0), ((0.0, -0.4, 0.0), 1.0), ((0.0, 0.0, 0.03), 1.0)],
)
def test_second_prediction_is_repeated_after_the_contact_has_moved(moved, again):
    """A model whose answer grows in proportion to what is not known: half a unit moves it by half of where it was."""
    sensitivity, first = Sensitivity(0.1), np.array([2.0, 1.0, 0.5])
    for at in (first, first + moved):
        shift = sensitivity.shift(
            Contact(*at, 0.1, 0.1, 0.01, 0.0), 0.05, partial(Contact, *2.0 * at, 0.1, 0.1, 0.01, 0.0)
        )
    np.testing.assert_allclose(shift, 0.5 * (first + again * np.array(moved)), rtol=1e-12)


def test_records_have_the_standard_deviations_of_an_uncertain_memory(film, predictor):
    """With a film known to a fifth, the deviation of the force is that of charges which are all wrong together."""
    press = film.charge_pC(np.full(1, 2.0), np.full(1, -3.0), np.full(1, 0.5))[0]
    frames = [*np.zeros((10, 3)), *np.outer(law(times(1.0)), press)]
    touch = TouchStream(
        predictor, device_from_table(MEMORY | {"tare": {"frames": 10}, "track": {}}, "b"), now_ns=lambda: 0
    )
    records = [
        record
        for k, row in enumerate(frames)
        for record in touch.feed(Chunk(encode_frame(Frame(k, 5000 * k, tuple(row))), 5.0 + k / RATE_HZ, 0))
    ]
    share = 0.2 * np.hypot(STEP * np.exp(-0.1 / WARMTH_S), CREEP)  # a tenth of a second: a decade before the first
    charges = np.array(list(records[30].charge_pC.values()))
    moved = [predictor.predict(charges * (1.0 + sign * share)).force_N for sign in (0.5, -0.5)]
    plain = predictor.predict(charges)
    expected = np.hypot(plain.force_std_N, moved[0] - moved[1])
    assert records[30].force_std_N == pytest.approx(expected, rel=0.1)
    assert expected > 2.0 * plain.force_std_N
    assert records[30].tracked.force_std_N > 0.8 * expected
    stds = plain.x_std_mm, plain.y_std_mm  # of this film no place moves
    assert (records[30].x_std_mm, records[30].y_std_mm) == pytest.approx(stds)


def test_warming_charges_are_relative_to_their_mean():
    board = device_from_table({"common_mode": {"pC_per_K": {"A": 2.0, "B": -6.0, "C": 3.0, "D": 1.0}}}, "b")
    np.testing.assert_allclose(board.chain((*NAMES, "D")).pyro, np.array([2.0, -6.0, 3.0, 1.0]) / 3.0)


@pytest.mark.parametrize("per_K", [{"A": 1.0}, {"A": 0.0, "B": 0.0, "C": 0.0, "D": 0.0}])
def test_charges_of_warming_are_for_each_electrode(per_K):
    board = device_from_table({"common_mode": {"pC_per_K": per_K}}, "b")
    with pytest.raises(DeviceError, match=r"b: common_mode.pC_per_K: expected a number"):
        board.chain((*NAMES, "D"))


@pytest.mark.parametrize("table", [MEMORY, {"common_mode": {"pC_per_K": {"A": 1.0, "B": 1.0, "C": 1.0, "D": -1.0}}}])
def test_export_to_c_refuses_stages_that_c_does_not_have(table):
    with pytest.raises(DeviceError, match="does not exist in the signal chain in C"):
        device_header(device_from_table(table, "b"), (*NAMES, "D"))
