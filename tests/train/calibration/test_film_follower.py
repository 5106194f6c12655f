"""Tests of the film follower: offsets of warm fingers, wrong gains, directions of the film, and files of a model."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from tests.train.calibration.conftest import (
    DEGREE_MPa,
    calibrated_files,
    film_of,
    follow_touches,
    rms_errors,
    touch_charges,
    write_files,
)

from isocharge.common.errors import ModelError
from isocharge.common.statistics import rms
from isocharge.serve import (
    Chunk,
    Frame,
    Predictor,
    TouchStream,
    device_from_table,
    encode_frame,
)
from isocharge.serve.live.contact_stages import FollowFilm, Prediction
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.model.pretensions import read_pretensions
from isocharge.serve.signal_chain.stage import Setup
from isocharge.serve.signal_chain.thermal import TRIED_PC, ThermalRule
from isocharge.serve.tracking.film_follower import FilmFollower, FollowedContact, FollowRule
from isocharge.serve.tracking.touch_collector import ObservedTouch
from isocharge.serve.tracking.touch_misfits import TYPICAL_MISFIT, SeriesMisfits
from isocharge.simulate import Circle, load_sensor
from isocharge.train import CalibrationProblem, write_calibration
from isocharge.train.calibration.film_charge_series import film_charge_series
from isocharge.train.calibration.film_directions import film_directions
from isocharge.train.calibration.problem import FilmEstimate
from isocharge.train.calibration.result import film_without_presses
from isocharge.train.data.presses import draw_contacts
from kept import kept

pytestmark = pytest.mark.usefixtures("no_closed_backs")

WARM_TOUCHES = np.arange(120)

OFFSETS = {
    "constant": np.ones(WARM_TOUCHES.size),
    "varying": 1.0 + 0.5 * np.random.default_rng(9).standard_normal(WARM_TOUCHES.size),
    "decaying": np.exp(-WARM_TOUCHES / 30.0),
    "warming": 1.0 - np.exp(-WARM_TOUCHES / 30.0),
}
"""Offset of each touch over the largest offset of the session."""


@pytest.mark.first_cases(5)
@pytest.mark.parametrize("kind", OFFSETS)
@pytest.mark.parametrize("size_pC", [10.0, -30.0, -10.0, 30.0])
def test_common_offset_of_warm_fingers_is_not_taken_for_pretension(mine, problem, film, kind, size_pC):
    """Without an offset among its unknowns the follower moved by 0.3 to 1.2 MPa, up to six standard deviations."""
    model = Predictor(mine)
    follower = FilmFollower(model)
    calibrated_MPa = follower.film.pretension_MPa
    contact, charge = touch_charges(problem, film, model, 1.0, 130, seed=8)
    warm = slice(0, 120)
    cold = slice(120, None)
    follow_touches(follower, charge[warm] + size_pC * OFFSETS[kind][:, None])

    change_MPa = follower.film.pretension_MPa - calibrated_MPa
    assert follower.is_lost or abs(change_MPa) < 2.0 * follower.film.pretension_std_MPa
    for (x_mm, y_mm, force_N), row in zip(contact[cold], charge[cold], strict=True):
        answer = follower.follow_contact(follower.predictor.predict(row), row).contact
        assert follower.is_lost or abs(answer.x_mm - x_mm) < 4.0 * answer.x_std_mm
        assert follower.is_lost or abs(answer.y_mm - y_mm) < 4.0 * answer.y_std_mm
        assert follower.is_lost or abs(answer.force_N - force_N) < 4.0 * answer.force_std_N


@pytest.fixture
def film_stage(mine):
    """The stage that follows the film, before the first touch."""
    return FollowFilm(Setup(tuple("ABCD"), {FollowRule: FollowRule()}, predictor=Predictor(mine)))


def frame_at(stage, charge_pC, clock_s, flags=()):
    """Return a frame with the contact that the model of a stage predicts; None as the charge for no contact."""
    frame = Frame(None, None, (), charge_pC=charge_pC, clock_s=clock_s, flags=list(flags))
    frame.is_contact = charge_pC is not None
    Prediction(stage._setup).step(frame)
    return frame


def test_touch_with_invalid_frames_counts_once(film_stage, touch_charge):
    for number in range(100):
        is_invalid = number % 20 == 7
        film_stage.step(
            frame_at(film_stage, None if is_invalid else touch_charge, 0.01 * number, ("invalid",) * is_invalid)
        )
    film_stage.step(frame_at(film_stage, None, 1.0))
    assert film_stage._follower.film.touches == 1


@pytest.mark.parametrize("misfit", [0.5, 50.0])
def test_flags_of_a_followed_film_belong_to_the_corrected_contact(film_stage, touch_charge, monkeypatch, misfit):
    """The contact before the correction has a misfit on the other side of the limit."""
    frame = frame_at(film_stage, touch_charge, 0.0, ("gap",))
    frame.contact_flags = () if misfit > 1.0 else ("misfit",)
    corrected_contact = frame.contact._replace(misfit=misfit)
    monkeypatch.setattr(
        film_stage._follower, "follow_contact", lambda *_: FollowedContact(corrected_contact, touch_charge)
    )
    film_stage.step(frame)
    assert frame.flags == ["gap"]
    assert frame.contact_flags == (("misfit",) if misfit > 1.0 else ())


def test_film_that_is_lost_twice_keeps_the_state_before_the_latest_touches(mine, problem, film, monkeypatch):
    """The pretension is 0.35 MPa higher than in the calibration. The film is lost at the touches 70 and 90."""
    follower = FilmFollower(Predictor(mine))
    calibrated_MPa = follower.film.pretension_MPa
    lost_touches = {70, 71, 72, 90}
    monkeypatch.setattr(FilmFollower, "_is_gain_wrong", lambda self: self.film.touches in lost_touches)
    monkeypatch.setattr(FilmFollower, "_is_unexplained", lambda _: False)
    _, charge = touch_charges(problem, film, Predictor(mine), 1.0 + DEGREE_MPa, 90, seed=8)
    pretensions_MPa = []
    for number, row in enumerate(charge):
        follower.observe_touch(ObservedTouch(follower.predictor.predict(row), row), 5.0 * number)
        pretensions_MPa.append(follower.film.pretension_MPa)
    assert follower.is_lost
    assert pretensions_MPa[69] == pretensions_MPa[89] == pretensions_MPa[29]
    assert pretensions_MPa[29] > calibrated_MPa + 0.5 * DEGREE_MPa


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_changed_film_is_followed_although_offsets_are_possible(mine, problem, film, sign):
    follower = FilmFollower(Predictor(mine))
    calibrated_MPa = follower.film.pretension_MPa
    _, charge = touch_charges(problem, film, follower.predictor, 1.0 + sign * DEGREE_MPa, 60, seed=8)
    follow_touches(follower, charge)
    change_MPa = follower.film.pretension_MPa - calibrated_MPa
    assert not follower.is_lost
    assert change_MPa == pytest.approx(sign * DEGREE_MPa, abs=0.15)


def test_offset_beyond_the_setting_stops_the_following(mine, problem, film):
    follower = FilmFollower(Predictor(mine), FollowRule(largest_offset_pC=3.0))
    _, charge = touch_charges(problem, film, follower.predictor, 1.0, 60, seed=8)
    follow_touches(follower, charge + 15.0)
    assert follower.is_lost


def test_without_an_offset_setting_warmth_is_taken_for_pretension(mine, problem, film):
    """`largest_offset_pC = 0` assumes that there are no offsets, as the follower once did."""
    follower = FilmFollower(Predictor(mine), FollowRule(largest_offset_pC=0.0))
    calibrated_MPa = follower.film.pretension_MPa
    _, charge = touch_charges(problem, film, follower.predictor, 1.0, 60, seed=8)
    follow_touches(follower, charge + 10.0)
    assert abs(follower.film.pretension_MPa - calibrated_MPa) > 0.25


def test_offset_that_differs_between_electrodes_is_recognised_by_its_ratio(mine, problem, film):
    ratio = np.array([1.4, 0.6, 1.4, 0.6])
    follower = FilmFollower(Predictor(mine), offset_ratio=ratio)
    calibrated_MPa = follower.film.pretension_MPa
    _, charge = touch_charges(problem, film, follower.predictor, 1.0, 60, seed=8)
    follow_touches(follower, charge + 10.0 * ratio)
    assert abs(follower.film.pretension_MPa - calibrated_MPa) < 2.0 * follower.film.pretension_std_MPa


def warming_without_noise(predictor, charge):
    """Return the warming that minimises the squared misfit of each row of charges, where temperature is separable."""
    warming_pC = []
    for row in charge:
        squared_misfits = np.square(predictor.predict_batch(row - TRIED_PC[:, None]).misfit, dtype=float)
        curvature, slope, _ = np.polyfit(TRIED_PC, squared_misfits, 2)
        is_separable = curvature > (ThermalRule().noise / ThermalRule().blind_pC) ** 2
        if is_separable:
            warming_pC.append(np.clip(-slope / (2.0 * curvature), TRIED_PC[0], TRIED_PC[-1]))
    return np.array(warming_pC)


def test_followed_film_shows_little_warming_anywhere(mine, problem, film):
    """A film that is a degree tauter shows 17 pC of warming that is not there, rms over places, as calibrated."""
    follower = FilmFollower(Predictor(mine))
    _, charge = touch_charges(problem, film, follower.predictor, 1.0 + DEGREE_MPa, 60, seed=8)
    contact = draw_contacts(np.random.default_rng(1), problem.domain.within(6.0), 40)
    held_charge = film(1.0 + DEGREE_MPa).charges(contact)
    calibrated_pC = warming_without_noise(follower.predictor, held_charge)
    follow_touches(follower, charge)
    followed_pC = warming_without_noise(follower.predictor, held_charge)
    assert np.sqrt(np.mean(calibrated_pC**2)) > 15.0
    assert np.sqrt(np.mean(followed_pC**2)) < 5.0


def mean_warming(mine, problem, film, seed):
    """Follow a film that is a degree tauter, and return the mean warming that the signal chain estimates at a place."""
    device = device_from_table({"follow": {"on": True}, "common_mode": {"on": True}}, "test")
    stream = TouchStream(Predictor(mine), device)
    _, charge = touch_charges(problem, film, stream.predictor, 1.0 + DEGREE_MPa, 60, seed=seed)
    (film_stage,) = [stage for stage in stream._contact_stages if isinstance(stage, FollowFilm)]
    follow_touches(film_stage._follower, charge)
    held = film(1.0 + DEGREE_MPa).charges(np.array([[4.0, 3.0, 0.5]]))
    clean = np.vstack([np.zeros((110, 4)), np.tile(held, (400, 1))])
    raw = problem.noise.add(clean, np.random.default_rng(seed))
    frames = [Frame(number, 5000 * number, tuple(row.tolist())) for number, row in enumerate(raw)]
    records = [
        record for frame in frames for record in stream.feed(Chunk(encode_frame(frame), 1.7e9 + 0.005 * frame.seq, 0))
    ]
    return np.mean([record.charge_raw_pC["A"] - record.charge_pC["A"] for record in records[300:]])


def test_common_mode_estimates_warming_by_the_followed_film(mine, problem, film):
    """The signal chain uses the misfit of the followed film, here at one place after each of four sets of touches.

    As calibrated, the mean of the warming at this place would be -16 pC. An error of the pretension of 0.05 MPa, which
    is half of the reported standard deviation, changes it by 7 pC.
    """
    warming_pC = [mean_warming(mine, problem, film, seed) for seed in (8, 9, 10, 11)]
    assert rms(np.array(warming_pC)) < 9.0


def estimated_film(problem, gain_std=0.0, coefficients=None):
    """Return an estimate of a film of 1 MPa without presses, in which only the gain of the first electrode is unknown.

    Args:
        problem: The films.
        gain_std: Standard deviation of the logarithm of this gain.
        coefficients: Coefficients of the first modes of the film.
    """
    layout = problem.charges.layout
    variance = np.full(layout.film_count, 1e-8)
    first_gain = layout.parameter_count - len(problem.electrodes)
    variance[first_gain] = (gain_std / problem.prior.spread.gain) ** 2
    film_coefficients = np.zeros(layout.coefficient_count)
    if coefficients is not None:
        film_coefficients[: len(coefficients)] = coefficients
    joint = np.diag(variance)
    covariance = joint[layout.parameters, layout.parameters]
    estimate = FilmEstimate(film_of(problem), covariance, film_coefficients, joint)
    return film_without_presses(problem, estimate, "estimated")


def test_directions_of_an_unknown_gain_change_one_charge(problem):
    directions = film_directions(estimated_film(problem, gain_std=0.2))
    contact = draw_contacts(np.random.default_rng(5), problem.domain, 50)
    log_changes = np.abs(directions.log_changes(contact)[:, 0])
    np.testing.assert_allclose(log_changes, np.tile([0.2, 0.0, 0.0, 0.0], (50, 1)), atol=0.01)


def test_series_of_the_charges_agree_with_the_film_at_other_pretensions(problem):
    """An uneven tension changes the charges of a tauter film less than those of the calibrated film."""
    result = estimated_film(problem, coefficients=[2.0, -1.5])
    calibrated_MPa = float(result.posterior.unknowns[0])
    series = film_charge_series(result, (0.3, 2.0))
    contact = draw_contacts(np.random.default_rng(6), problem.domain, 200)
    for pretension_MPa, tolerance in ((calibrated_MPa, 1e-3), (0.7, 2.5e-3), (1.4, 2.5e-3)):
        film = series.interpolated(np.array([pretension_MPa]))
        charge_pC, _ = film.charges(film.unit_contact(contact)[None])
        unknowns = result.posterior.unknowns.copy()
        unknowns[0] = pretension_MPa
        expected_pC = problem.charges.charges(unknowns, contact)
        assert rms(np.log(charge_pC[0] / expected_pC)) < tolerance  # the noise is 2e-3 or more


def test_charges_of_both_signs_have_no_series(problem, monkeypatch):
    result = estimated_film(problem)
    monkeypatch.setattr("isocharge.simulate.ForwardMap.charges", lambda _map, contact: -np.ones((len(contact), 4)))
    assert film_charge_series(result, (0.5, 2.0)) is None


@pytest.mark.parametrize("pretension_MPa", [0.7, 1.0, 1.4])
def test_misfits_of_touches_agree_with_contacts_that_scipy_fits(problem, pretension_MPa):
    """The misfit vector is the residual of the best contact, which SciPy searches, also after a change of a charge."""
    result = estimated_film(problem)
    unknowns = result.posterior.unknowns.copy()
    unknowns[0] = pretension_MPa
    film = problem.charges.film(unknowns)
    noise = ModelNoise(name="reference", white_pC=1.0, gain=0.002)
    series = film_charge_series(result, (0.3, 2.0))
    at_nodes = SeriesMisfits(series, noise, series.node_MPa, series.node_MPa)
    misfits = at_nodes.at_pretension(pretension_MPa)

    # The touches are those of the calibrated film, so the film at another pretension does not explain them completely.
    domain = replace(problem.domain, radius=0.7 * problem.domain.radius)
    contact = draw_contacts(np.random.default_rng(7), domain, 8)
    charge = problem.charges.charges(result.posterior.unknowns, contact)
    log_changes = 0.01 * np.eye(4)
    for touch_contact, touch_charge in zip(contact, charge, strict=True):
        noise_std = np.sqrt(noise.variance(touch_charge))

        def fitted_misfit(measured, start=touch_contact, noise_std=noise_std):
            def residual(trial):
                return (measured - film.charges(trial[None])[0]) / noise_std

            return least_squares(residual, start, x_scale=[1.0, 1.0, start[2]], xtol=1e-12, ftol=1e-12).fun

        linearised = misfits.linearise(touch_charge[None], touch_contact, log_changes)
        expected = fitted_misfit(touch_charge)
        np.testing.assert_allclose(
            TYPICAL_MISFIT * linearised.vectors[0, 0], expected, atol=0.15 + 0.02 * np.abs(expected).max()
        )
        changes = TYPICAL_MISFIT * linearised.changes[0]
        largest_change = np.abs(changes).max()
        for electrode, log_change in enumerate(log_changes):
            expected_change = fitted_misfit(touch_charge * np.exp(log_change)) - expected
            np.testing.assert_allclose(changes[:, electrode], expected_change, atol=0.15 * largest_change)


def test_network_at_another_pretension_has_the_uneven_tension_of_the_film(problem):
    """An uneven tension changes the charges of a tauter film less than those of the calibrated film."""
    result = estimated_film(problem, coefficients=[2.0, -1.5])
    tauter = result.posterior.unknowns.copy()
    tauter[0] += 2.0 * DEGREE_MPa
    parameters = tauter[problem.charges.layout.parameters]
    contact = draw_contacts(np.random.default_rng(6), problem.domain, 200)
    charge = problem.charges.charges(tauter, contact)
    answer, *_ = result.fitted_film(parameters).network.predict(charge)
    log_force_error = np.log(answer[:, 2] / contact[:, 2])
    assert np.sqrt(np.mean(log_force_error**2)) < 0.006


@pytest.fixture(scope="module")
def film_with_unknown_gain(problem, tmp_path_factory) -> Path:
    """The folder of a film whose first gain is known to 3 %."""
    folder = tmp_path_factory.mktemp("films") / "unknown-gain"
    write_calibration(estimated_film(problem, gain_std=0.03), folder)
    return folder


def followed_error(folder, problem, film, gain):
    """Return the errors of a follower of a film with a wrong gain after 60 touches: of places, mm, and forces, %."""
    follower = FilmFollower(Predictor(folder))
    contact, charge = touch_charges(problem, film, follower.predictor, 1.0, 160, seed=8)
    charge[:, 0] *= gain
    follow_touches(follower, charge[:60])
    answer = [follower.follow_contact(follower.predictor.predict(row), row).contact for row in charge[60:]]
    place_error = [np.hypot(one.x_mm - x, one.y_mm - y) for one, (x, y, _) in zip(answer, contact[60:], strict=True)]
    log_force_error = [np.log(one.force_N / force) for one, (_, _, force) in zip(answer, contact[60:], strict=True)]
    return rms_errors(np.column_stack([place_error, log_force_error]))


def test_gain_that_the_calibration_left_uncertain_is_followed(film_with_unknown_gain, problem, film, tmp_path):
    """Without the file of directions, the gain is wrong in every answer, and may be taken for a change of the film."""
    with_directions = followed_error(film_with_unknown_gain, problem, film, gain=1.04)
    folder = shutil.copytree(film_with_unknown_gain, tmp_path / "without")
    (folder / "1" / "film_directions.npz").unlink()
    without_directions = followed_error(folder, problem, film, gain=1.04)
    assert with_directions[0] < 0.19
    assert with_directions[0] < 0.7 * without_directions[0]
    assert with_directions[1] < 2.5


def test_between_its_pretensions_it_is_the_network_for_all_films(mine, problem):
    """Interpolated weights against the network that `calibrate` folds for that film."""
    known, folder = read_pretensions(mine / "1"), mine / "1"
    table = json.loads((folder / "calibration.json").read_text("utf-8"))
    values = [entry["value"] for entry in table["parameters"].values()]
    middle = float(known.node_MPa[3:5].mean())
    parameters = problem.prior.parameters_of(load_sensor(folder / "sensor.toml"), problem.probe)
    parameters[problem.prior.names.index("probe_radius")] = 1e3 * values[problem.prior.names.index("probe_radius")]
    parameters[0] = middle
    at = draw_contacts(np.random.default_rng(2), problem.domain, 300)
    charge = problem.noise.add(problem.charges.charges(parameters, at), np.random.default_rng(3))
    folded = problem.films.fold(parameters).predict(charge)[0]
    answer = np.asarray(Predictor(mine).with_constants(known.constants(middle)).predict_batch(charge))
    apart = np.hypot(*(answer[:, :2] - folded[:, :2]).T)
    assert np.sqrt(np.mean(apart**2)) < 0.06  # what the film has besides its parameters was taught to the one alone
    nodes = known.interpolated(np.linspace(*known.range_MPa, 29))
    misfits = [nodes.misfits(row, np.array([middle]))[0] for row in charge[:20]]
    followed = Predictor(mine).with_constants(known.constants(middle)).predict_batch(charge[:20]).misfit
    np.testing.assert_allclose(misfits, followed, atol=0.05)


@pytest.fixture
def touch_charge(problem, film, mine):
    """Charges of one touch of the calibrated film, shape (4,), pC."""
    _, charge = touch_charges(problem, film, Predictor(mine), 1.0, 1, seed=8)
    return charge[0]


@pytest.mark.parametrize(
    ("flags", "counted"),
    [((), 1), (("stress",), 1), (("misfit",), 1), (("saturated",), 0), (("thermal",), 0), (("outside", "thermal"), 0)],
)
def test_flag_of_a_frame_decides_whether_its_touch_counts(mine, touch_charge, flags, counted):
    follower = FilmFollower(Predictor(mine))
    contact = follower.predictor.predict(touch_charge)
    for frame_flags in (("outside", "misfit"), (), flags):
        follower.observe_frame(touch_charge, contact, frame_flags, 0.0)
    follower.observe_frame(touch_charge, None, (), 0.1)
    assert follower.film.touches == counted


def test_touch_does_not_count_if_no_contact_explains_its_average_charges(mine, film):
    follower = FilmFollower(Predictor(mine))
    wrong_charge = film(1.0).charges(np.array([[0.0, 0.0, 0.5]]))[0] * [1.2, 0.8, 1.2, 0.8]
    contact = follower.predictor.predict(wrong_charge)
    for _ in range(10):
        follower.observe_frame(wrong_charge, contact, follower.predictor.flags(contact), 0.0)
    follower.observe_frame(wrong_charge, None, (), 0.1)
    assert "misfit" in follower.predictor.flags(contact)
    assert follower.film.touches == 0


def test_touches_with_many_noisy_frames_count(mine, problem, film):
    """Without the average, a single frame with a large misfit would exclude most of these touches."""
    follower = FilmFollower(Predictor(mine))
    contact, _ = touch_charges(problem, film, follower.predictor, 1.0, 10, seed=8)
    rng = np.random.default_rng(3)
    touches_with_misfit = 0
    for charge in film(1.0).charges(contact):
        frames = charge + 2.5 * problem.noise.sigma(charge) * rng.standard_normal((64, charge.size))
        frame_contacts = [follower.predictor.predict(frame) for frame in frames]
        frame_flags = [follower.predictor.flags(frame_contact) for frame_contact in frame_contacts]
        touches_with_misfit += any("misfit" in flags for flags in frame_flags)
        for frame, frame_contact, flags in zip(frames, frame_contacts, frame_flags, strict=True):
            follower.observe_frame(frame, frame_contact, flags, 0.0)
        follower.observe_frame(None, None, (), 0.1)
    assert touches_with_misfit > 5
    assert follower.film.touches == 10


@pytest.mark.parametrize("misfit_count", [6, 7, 12])
def test_touches_with_a_misfit_count_if_most_touches_have_one(mine, film, touch_charge, misfit_count):
    """Of twelve touches, the last ones have a misfit. They count from the seventh touch with a misfit on."""
    follower = FilmFollower(Predictor(mine))
    misfit_charge = film(1.0).charges(np.array([[0.0, 0.0, 0.5]]))[0] * [1.2, 0.8, 1.2, 0.8]
    good_count = 12 - misfit_count
    follow_touches(follower, np.array([touch_charge] * good_count + [misfit_charge] * misfit_count))
    used_misfits = max(misfit_count - 6, 0)
    assert follower.film.touches == good_count + used_misfits


@pytest.mark.slow
@pytest.mark.parametrize("change_MPa", [-DEGREE_MPa, DEGREE_MPa])
def test_uniaxial_film_is_followed_although_most_touches_have_a_misfit(tmp_path, change_MPa):
    """The calibrated model has errors of the force of 13 to 17 %."""
    problem = CalibrationProblem.of(load_sensor("four-25um-uniaxial"), Circle(1.0))
    model = Predictor(write_files(tmp_path / "uniaxial", kept(calibrated_files, "four-25um-uniaxial", 5)))
    changed_film = problem.charges.forward_map(np.append(1.0 + change_MPa, film_of(problem)[1:]))
    contact, charge = touch_charges(problem, lambda _: changed_film, model, 1.0 + change_MPa, 120, seed=8)
    touches = slice(0, 60)
    later = slice(60, 120)
    touches_with_misfit = ["misfit" in model.flags(model.predict(row)) for row in charge[touches]]
    assert np.mean(touches_with_misfit) > 0.5

    follower = FilmFollower(model)
    follow_touches(follower, charge[touches])
    answers = [follower.follow_contact(follower.predictor.predict(row), row).contact for row in charge[later]]
    force_N = np.array([answer.force_N for answer in answers])
    assert rms(force_N / contact[later, 2] - 1.0) < 0.02


@pytest.mark.parametrize("change", ["gone", "damaged", "another model", "another model without checksums"])
def test_a_file_that_cannot_be_used(mine, tmp_path, change):
    folder = tmp_path / "mine"
    for name in ("model.onnx", "golden.json", "pretensions.npz"):
        (folder / "1").mkdir(parents=True, exist_ok=True)
        (folder / "1" / name).write_bytes((mine / "1" / name).read_bytes())
    path = folder / "1" / "pretensions.npz"
    if change == "gone":
        path.unlink()
    elif change == "damaged":
        path.write_bytes(path.read_bytes()[:-100])
    else:
        known = read_pretensions(folder / "1")
        weights = {name: 1.01 * rows for name, rows in known.weights.items()}
        path.write_bytes(replace(known, weights=weights).to_bytes())
    if change == "another model without checksums":
        golden = json.loads((folder / "1" / "golden.json").read_text("utf-8"))
        del golden["files"]
        (folder / "1" / "golden.json").write_text(json.dumps(golden), "utf-8")
    with pytest.raises(ModelError, match=r"pretensions\.npz.*calibrate"):
        FilmFollower(Predictor(folder))
