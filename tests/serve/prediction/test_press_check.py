"""Comparison of a model with measured presses, for a linear film whose inverse and noise are known in closed form.

The standard deviations of the model are 50 mm pC / (sum of the charges) for the position and 7e-4 N for the force. The
contacts are moved by noise of this size, so that chi-squared, its distribution and each part of the errors are known.
The chi-squared distribution is compared with SciPy. The guarantee of the factor for standard deviations is tested on
presses whose errors do not follow the model.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from isocharge.serve import MeasuredPresses, Predictor, check_presses
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.prediction.press_errors import chi_squared_survival, common_error, press_errors
from isocharge.serve.presses.std_factor import FEWEST_HELD_OUT, REGION_QUANTILES, StdFactor, binomial_distribution

RIG_STD_MM = 0.05
RIG_FORCE_STD = 0.004


@pytest.fixture
def measure(film):
    """Return a function that measures presses with noise of the charges, errors of the rig and errors of the model."""

    def measure(n, *, seed=0, force_scale=1.0, shift_mm=(0.0, 0.0), known=(True, True), noise=1.0):
        rng = np.random.default_rng(seed)
        contact = rng.uniform([-3.5, -3.5, 0.1], [3.5, 3.5, 1.8], (n, 3))
        std = 50.0 / (2400.0 * contact[:, 2])  # of the model, from the sum of the charges
        moved = contact + noise * rng.normal(size=(n, 3)) * np.column_stack([std, std, np.full(n, 7e-4)])
        moved += [*shift_mm, 0.0]
        moved[:, 2] *= force_scale
        contact[:, :2] += RIG_STD_MM * rng.normal(size=(n, 2))
        contact[:, 2] /= 1.0 + RIG_FORCE_STD * rng.normal(size=n)
        contact[:, [not known[0], not known[0], not known[1]]] = np.nan
        stds = np.full(n, RIG_STD_MM), np.full(n, RIG_FORCE_STD)
        return MeasuredPresses(contact, film.charge_pC(*moved.T), *stds, film.electrodes, tuple(range(2, n + 2)))

    return measure


@pytest.fixture
def checked(predictor, measure):
    """Return a function that measures presses and compares the model with them."""
    return lambda n, **conditions: check_presses(predictor, measure(n, **conditions))


def test_errors_of_single_presses_equal_their_displacements(film, predictor):
    """The electrodes of the presses are in another order than those of the model.

    The first and the last press are at one place, and share the error of its position.
    """
    contact = np.array([[1.0, 2.0, 0.5], [-3.0, 0.5, 1.0], [np.nan, np.nan, 1.0], [1.0, 2.0, np.nan]])
    pressed = np.array([[1.3, 1.6, 0.55], [-3.0, 0.5, 0.98], [0.0, 0.0, 1.02], [1.0, 2.5, 1.0]])
    stds = np.full(4, 0.1), np.full(4, 0.01)
    charge_pC = film.charge_pC(*pressed.T)[:, ::-1]
    presses = MeasuredPresses(contact, charge_pC, *stds, film.electrodes[::-1], (2, 3, 4, 5))
    errors = check_presses(predictor, presses).errors
    nan = np.nan
    np.testing.assert_allclose(errors.position_error_mm, [0.5, 0.0, nan, 0.5], atol=1e-5)
    np.testing.assert_allclose(errors.error[:, 2], [0.1, -0.02, 0.02, nan], atol=1e-6)
    np.testing.assert_allclose(errors.predicted[:, :3], pressed, atol=1e-5)
    std = 50.0 / (2400.0 * pressed[:, 2])
    np.testing.assert_allclose(errors.noise_std[:, 0], np.where([1, 1, 0, 1], std, nan), rtol=1e-5)
    np.testing.assert_allclose(errors.noise_std[:, 2], [7e-4 / 0.5, 7e-4, 7e-4, nan], rtol=1e-5)
    np.testing.assert_array_equal(errors.rig_std[:, 2], [0.01, 0.01, 0.01, nan])
    np.testing.assert_allclose(errors.variance[:, 1] - errors.noise_std[:, 1] ** 2, [0.02, 0.01, nan, 0.02])


def test_model_that_fits_has_no_unexplained_error(checked):
    check = checked(400, seed=3)
    assert (check.fits, check.verdict, check.notes) == (True, "fits: noise explains the errors", ())
    assert check.agreement.degrees == 1200
    for part, rig in ((check.position_mm, RIG_STD_MM * 2**0.5), (check.force_percent, 100 * RIG_FORCE_STD)):
        assert part.rms == pytest.approx(part.explained, rel=0.1)
        assert part.rig == pytest.approx(rig)
        assert part.beyond < 0.45 * part.rms


def test_p_values_are_uniform_and_verdicts_rarely_wrong_for_a_model_that_fits(checked):
    checks = [checked(12, seed=seed) for seed in range(150)]
    assert stats.kstest([check.agreement.p_value for check in checks], "uniform").pvalue > 0.01
    assert sum(not check.fits for check in checks) <= 5  # 1 % of 150, plus three standard deviations


def test_chi_squared_up_to_ten_percent_too_large_is_accepted_whatever_the_p_value(checked):
    agreement = checked(12).agreement
    larger = [replace(agreement, p_value=1e-9, chi_squared=share * agreement.degrees) for share in (1.05, 1.2)]
    assert [each.acceptable for each in larger] == [True, False]
    assert replace(larger[1], p_value=0.2).acceptable


def test_common_shift_is_detected_with_a_smaller_p_value_than_chi_squared(checked):
    check = checked(40, seed=1, shift_mm=(0.06, 0.0))
    assert check.fits is False
    assert check.agreement.p_value > check.agreement.common_p_value
    assert check.agreement.common.mean[0] == pytest.approx(0.06, abs=4 * check.agreement.common.std[0])
    assert "positions are off by (0.0" in str(check.notes)


@pytest.mark.parametrize(("known", "degrees"), [((True, False), 40), ((False, True), 20)])
def test_presses_with_only_positions_or_only_forces(checked, known, degrees):
    check = checked(20, known=known)
    assert (check.fits, check.agreement.degrees) == (True, degrees)
    assert (check.position_mm is None, check.force_percent is None) == (not known[0], not known[1])
    wrong = checked(20, known=known, noise=8.0, force_scale=1.1)
    assert wrong.fits is False
    assert ("mm" in wrong.verdict, "%" in wrong.verdict) == known
    assert ("forces are 1." in str(wrong.notes)) == known[1]


def test_correlated_errors_are_compared_with_their_covariance(checked):
    errors = checked(3, known=(True, False)).errors
    errors.predicted[:, 7:] = 0.9  # correlations of the noise
    error, noise_std, variance = errors.error[0, :2], errors.noise_std[0, :2], errors.variance[0, :2]
    covariance = 0.9 * np.outer(noise_std, noise_std)
    np.fill_diagonal(covariance, variance)
    assert errors.chi_squared[0] == pytest.approx(error @ np.linalg.solve(covariance, error), rel=1e-3)


@pytest.mark.parametrize(("count", "fits"), [(2, None), (3, True)])
def test_verdict_needs_three_presses(checked, count, fits):
    check = checked(count, seed=4)
    assert check.fits is fits
    assert fits or check.verdict == f"too few presses to say: {count} can be compared, 3 are needed"
    far = checked(count, seed=4, shift_mm=(1.0, 0.0))
    assert ("shifted" in str(far.notes)) == (count >= 3)  # one wrong press is no common shift


def test_bad_press_is_reported_and_excluded(predictor, measure):
    presses = measure(12, seed=5)
    presses.contact[7, :2] += 2.0
    check = check_presses(predictor, presses)
    assert (check.fits, check.compared) == (True, 11)
    assert check.notes == ("line 9: nothing like the other presses, left out; look at it",)
    presses.contact[3:5, :2] -= 2.0  # three of twelve are too many
    assert check_presses(predictor, presses).fits is False


def test_presses_outside_the_domain_or_with_unknown_values_are_excluded(predictor, measure):
    presses = measure(10, seed=6)
    presses.contact[0, 2] = 40.0  # N: meant as g
    presses.contact[1, :2] = 30.0  # mm
    presses.contact[2] = np.nan
    presses.charge_pC[3, 1] = np.nan
    check = check_presses(predictor, presses)
    assert (check.presses, check.compared, check.fits) == (10, 6, True)
    assert check.errors.exclusion_reasons.tolist()[:5] == [
        "not trained for",
        "not trained for",
        "neither place nor force is known",
        "a charge is unknown",
        "",
    ]
    assert "0.05 to 2 N); if these are most, look at the units (lines 2, 3)" in check.notes[2]
    row = check.to_dict()["each"][3]
    assert (row["x_mm"], row["x_error_mm"], row["left_out"]) == (None, None, "a charge is unknown")


def test_notes_for_a_film_that_does_not_fit_name_the_rig_and_the_calibration(predictor, measure):
    """With the true scatter of the rig, the same presses fit."""
    presses = measure(30, seed=1)
    presses.contact[:, :2] += np.random.default_rng(0).normal(0.0, 0.2, (30, 2))
    check = check_presses(predictor, presses)
    assert "--position-std, --force-std, or columns of the file, which take precedence" in check.notes[0]
    assert "at least 500 measured presses" in check.notes[1]
    known = replace(presses, position_std_mm=np.full(30, np.hypot(0.2, RIG_STD_MM)))
    assert check_presses(predictor, known).fits


@pytest.mark.parametrize(
    ("misfits", "ratio", "fits"),
    [
        (2, 1.6, True),  # two of 30 are chance
        (4, 1.6, False),
        (4, 1.4, True),  # the noise is 1.4 times as large as that of the model
    ],
)
def test_verdict_depends_on_the_number_of_misfits(film, tmp_path, measure, misfits, ratio, fits):
    """The ratio is that of the largest misfits to the misfit that 1 % of good presses exceed."""
    charge_pC = [-1.0, 900.0, 900.0]
    film.write(tmp_path / "film")
    answer = Predictor("linear", models=tmp_path / "film").predict(charge_pC)
    film.write(tmp_path / "stated", errors={"misfit_p99": answer.misfit / ratio})
    presses = measure(30)
    presses.charge_pC[:misfits] = charge_pC
    presses.contact[:misfits] = np.nan, np.nan, answer.force_N
    predictor = Predictor("linear", models=tmp_path / "stated")
    check = check_presses(predictor, presses)
    assert (check.fits, "4 of 30 presses have a misfit above" in check.verdict) == (fits, not fits)
    presses.position_std_mm[:] *= 0.1  # too small for the errors
    assert ("-std" in check_presses(predictor, presses).notes[0]) == fits


def predictor_with_noise(film, folder, white_pC):
    """Return a model of the linear film whose charges have this noise. It states the same standard deviations."""
    return Predictor(film.write(folder, noise=ModelNoise(name="white", white_pC=white_pC, gain=0.0)))


@pytest.mark.parametrize("white_pC", [0.5, 2.0])
def test_uncertain_film_causes_the_variance_that_the_noise_does_not_cause(film, tmp_path, measure, white_pC):
    """The force is proportional to the sum of three charges, 2400 pC for 1 N, and has the stated error 7e-4 N."""
    errors = press_errors(predictor_with_noise(film, tmp_path, white_pC), measure(4))
    film_variance = 7e-4**2 - 3.0 * (white_pC / 2400.0) ** 2
    film_std_N = errors.film_std[:, 2] * errors.presses.contact[:, 2]
    assert film_std_N == pytest.approx(np.full(4, math.sqrt(max(film_variance, 0.0))), rel=0.02)


def test_error_that_an_uncertain_film_may_cause_in_all_presses_is_accepted(film, tmp_path, checked, measure):
    """The film of a model without noise causes all errors that the model states."""
    uncertain = predictor_with_noise(film, tmp_path, 0.0)
    for noise, shift_mm, fits_uncertain_film in ((1.0, 0.06, True), (1.8, 0.0, True), (1.0, 0.5, False)):
        conditions = {"noise": noise, "shift_mm": (shift_mm, 0.0)}
        assert checked(40, **conditions).fits is False
        assert check_presses(uncertain, measure(40, **conditions)).fits is fits_uncertain_film


def test_equal_part_of_the_errors_reduces_the_significance_of_a_common_error():
    """All errors are 0.1 mm."""
    error = np.full((400, 1), 0.1)
    variance = np.full((400, 1), 0.01 + 0.2**2)
    common = common_error(error, variance, np.full((400, 1), 0.04))
    assert common.significance[0] == pytest.approx(0.1 / math.hypot(common.std[0], 0.04))


@pytest.mark.parametrize(("degrees", "tolerance"), [(1, 0.05), (2, 0.013), (3_000_000, 1e-6)])
def test_chi_squared_survival_is_near_scipy(degrees, tolerance):
    for sigmas in np.linspace(-4.0, 20.0, 49):
        statistic = max(0.0, degrees + sigmas * math.sqrt(2.0 * degrees))
        assert chi_squared_survival(statistic, degrees) == pytest.approx(
            stats.chi2.sf(statistic, degrees), abs=tolerance
        )


def test_binomial_distribution_is_that_of_scipy():
    expected = stats.binom.cdf(np.arange(2001), 2000, 0.01)
    np.testing.assert_allclose(binomial_distribution(2000, 0.01), expected, atol=1e-10)


# Factor for standard deviations


def draw(rng, count, scale, degrees_of_freedom):
    """Return errors with heavy tails and stated standard deviations that are wrong by a factor, both (count, 3)."""
    std = rng.uniform(0.5, 2.0, (count, 3))
    return scale * std * rng.standard_t(degrees_of_freedom, (count, 3)), std


def coverage(factor, error, std):
    return np.mean(np.sum((error / (factor * std)) ** 2, axis=1) <= stats.chi2.ppf(0.95, 3))


@pytest.mark.parametrize("count", [22, 30, 100])
def test_regions_hold_for_at_least_ninety_percent_of_contacts_on_ninety_percent_of_films(count):
    rng = np.random.default_rng(count)
    holds = []
    for _ in range(400):
        scale, degrees_of_freedom = rng.uniform(0.3, 4.0), rng.integers(3, 30)
        factor = StdFactor.from_errors(*draw(rng, count, scale, degrees_of_freedom)).factor
        holds.append(coverage(factor, *draw(rng, 2000, scale, degrees_of_freedom)) >= 0.9)
    assert 0.88 < np.mean(holds) < 0.98


def test_check_states_a_factor_from_the_fewest_presses(checked):
    assert checked(FEWEST_HELD_OUT - 1).std_factor is None
    assert checked(FEWEST_HELD_OUT).std_factor.presses == FEWEST_HELD_OUT


def test_unknown_values_do_not_count():
    np.testing.assert_allclose(REGION_QUANTILES, stats.chi2.ppf(0.95, [1, 2, 3]), atol=1e-3)
    error = np.full((30, 3), np.nan)
    error[:, 2] = 2.0 * np.sqrt(REGION_QUANTILES[0])
    assert StdFactor.from_errors(error, np.ones((30, 3))).factor == pytest.approx(2.0)
    assert "standard deviations that are 2 times as large, the 95 % regions (without" in StdFactor(2.0, 30).statement


def test_standard_error_of_a_common_error_contains_the_scatter_of_the_presses():
    """The standard error of the mean of known values follows from their scatter if it is larger than expected."""
    error = np.array([[1.0], [3.0], [np.nan], [8.0]])
    common = common_error(error, np.full((4, 1), 0.01), np.zeros((4, 1)))
    assert common.std[0] == pytest.approx(stats.sem([1.0, 3.0, 8.0]))
