"""Following a film through touches, on a film whose charges are a closed formula and whose model searches exactly."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from drawn_contacts import draw_contacts
from isocharge.common.contact_domain import Domain
from isocharge.common.errors import ModelError
from isocharge.serve import Contact, Frame
from isocharge.serve.model.charge_file import FILE, charge_map_bytes
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.serve.signal_chain.stage import Device, Setup
from isocharge.serve.tracking.film_follower import FilmFollower, TouchPeak
from isocharge.serve.tracking.gaussian_components import contacts_of
from isocharge.simulate import NoiseModel, noise_model

NOISE = noise_model("reference")


def charge_map(*node_MPa):
    """Return a map of degree 2 whose charges fall with the pretension, most for small forces and near the centre."""
    rng = np.random.default_rng(0)
    base = np.zeros((3, 3, 2, 4))
    base[0, 0, 0], base[0, 0, 1] = 6.0, 1.2
    base[1, 0, 0], base[0, 1, 0] = [1.0, 0.1, -1.0, -0.1], [0.1, 1.0, -0.1, -1.0]
    base[2, 0, 0], base[0, 2, 0] = [0.1, -0.12, 0.1, -0.12], [-0.12, 0.1, -0.12, 0.1]
    tension = np.zeros_like(base)
    tension[0, 0, 0], tension[0, 0, 1] = [-0.4, -0.35, -0.3, -0.38], 0.1
    tension[1, 0, 0], tension[0, 1, 0] = [-0.1, 0.02, 0.1, 0.0], [0.02, -0.1, 0.0, 0.1]
    direction = 0.003 * rng.standard_normal((2, 2, 2, 2, 2, 4))
    return ChargeSeries(
        domain=Domain(8.0, (0.05, 2.0)),
        electrodes=tuple("ABCD"),
        coefficients=np.stack([base + node * tension for node in node_MPa]),
        node_MPa=np.array(node_MPa),
        directions=direction,
        charge_std=0.001,
        pretension_MPa=1.0,
        tension_std_MPa=0.35,
    )


@pytest.fixture(scope="module")
def series():
    return charge_map(-0.7, 0.0, 0.7)


def with_electrodes(series, count):
    """Return a charge map with another number of electrodes. The fifth electrode equals the first, and so on."""
    coefficients, directions = (array[..., np.arange(count) % 4] for array in (series.coefficients, series.directions))
    return replace(series, electrodes=tuple("ABCDEFGH"[:count]), coefficients=coefficients, directions=directions)


def model_in(folder, series, noise=NOISE):
    """Return a model of the calibrated film that searches for the nearest contact, and write its charge map.

    Args:
        folder: Folder of the model.
        series: Charge map of the film.
        noise: Noise that a device file states.
    """
    (folder / FILE).write_bytes(charge_map_bytes(series))

    def predict(charge_pC):
        contact = np.array([0.0, 0.0, np.log(0.5)])
        for _ in range(4):
            (charge,), (slopes,) = series.linearised(contacts_of(contact[None]))
            std = NOISE.sigma(charge)
            slopes = slopes / std[:, None]
            covariance = np.linalg.inv(slopes.T @ slopes)
            step = covariance @ slopes.T @ ((charge_pC - charge) / std)
            contact = np.clip(contact + step, [-9.0, -9.0, -4.0], [9.0, 9.0, 2.0])
        x_mm, y_mm, log_force = contact.tolist()
        std = np.sqrt(np.diag(covariance)) * [1.0, 1.0, np.exp(log_force)]
        return Contact(x_mm, y_mm, np.exp(log_force), *std, misfit=0.0)

    return SimpleNamespace(
        folder=folder,
        metadata=SimpleNamespace(electrodes=series.electrodes),
        noise=noise,
        predict=predict,
        validity=SimpleNamespace(flags=lambda _: ()),
    )


@pytest.fixture
def model(tmp_path, series):
    """The model of the calibrated film with the noise of its training."""
    return model_in(tmp_path, series)


def touches(series, state, rng, count):
    """Contacts and charges of a changed film."""
    contact = draw_contacts(rng, count, 6.5, (0.1, 1.5))
    return contact, series.in_state(contact, state).charge_pC


def new_follower(model):
    """Return a follower of the film of a model."""
    return FilmFollower(Setup(model.metadata.electrodes, Device(), model))


def followed(model, charge, rng, frames=2, noise=NOISE):
    """Return a follower that has observed touches, and whether the film was lost after each of them.

    Args:
        frames: Number of frames of a touch. The follower gets their mean as a single frame, which costs less time.
        noise: Noise of the frames.
    """
    follower = new_follower(model)
    was_lost = []
    for number, row in enumerate(charge):
        mean_charge = noise.add(np.tile(row, (frames, 1)), rng).mean(axis=0)
        contact = model.predict(mean_charge)
        follower.step(Frame(None, None, (), host_s=number, charge_pC=mean_charge, contact=contact))
        follower.step(Frame(None, None, (), host_s=number + 0.04))
        was_lost.append(follower.is_lost)
    return follower, was_lost


def force_errors(follower, model, contact, charge):
    """Root mean square of the relative errors of the forces, and share of the errors below two standard deviations."""
    answers = [follower.follow_contact(model.predict(row), row) for row in charge]
    error = np.array([answer.force_N for answer in answers]) - contact[:, 2]
    std = np.array([answer.force_std_N for answer in answers])
    return np.sqrt(np.mean((error / contact[:, 2]) ** 2)), np.mean(np.abs(error / std) < 2.0)


@pytest.mark.parametrize(
    ("change_MPa", "gain", "largest_error"), [(0.3, 1.0, 0.03), (-0.4, 1.0, 0.03), (0.0, 1.0, 0.01), (0.0, 1.03, 0.03)]
)
def test_changes_of_the_film_and_of_a_gain_are_followed(series, model, change_MPa, gain, largest_error):
    rng = np.random.default_rng(4)
    contact, charge = touches(series, [change_MPa, 0.7, -0.8], rng, 80)
    charge[:, 0] *= gain
    follower, was_lost = followed(model, charge[:50], rng)
    assert not was_lost[-1]
    assert abs(follower.film.pretension_MPa - 1.0 - change_MPa) < 3.0 * follower.film.pretension_std_MPa + 0.01
    rms_error, covered_share = force_errors(follower, model, contact[50:], NOISE.add(charge[50:], rng))
    assert rms_error < largest_error
    assert covered_share > 0.85


@pytest.mark.parametrize("n_electrode", [4, 8])
def test_film_is_followed_with_the_noise_that_the_device_file_states(series, tmp_path, n_electrode):
    """With the noise of the training, the film would be lost, or its pretension wrong by many standard deviations.

    All frames of a touch have the same noise, because the board filters its signals. Eight electrodes have five
    independent residuals instead of one.
    """
    rng = np.random.default_rng(4)
    noise = NoiseModel("bench", 5.0, 0.02)
    series = with_electrodes(series, n_electrode)
    model = model_in(tmp_path, series, noise)
    _, charge = touches(series, [0.3, 0.7, -0.8], rng, 60)
    follower, was_lost = followed(model, charge, rng, 1, noise)
    assert not any(was_lost)
    assert abs(follower.film.pretension_MPa - 1.3) < 2.0 * follower.film.pretension_std_MPa
    assert follower.film.pretension_std_MPa < 0.2


def test_errors_of_the_charge_map_are_not_taken_for_changes_of_the_film(series, tmp_path):
    """Each charge of a touch differs from that of the map by 3 %. The map states this error."""
    rng = np.random.default_rng(4)
    model = model_in(tmp_path, replace(series, charge_std=0.03))
    _, charge = touches(series, [0.3, 0.7, -0.8], rng, 60)
    follower, _ = followed(model, charge * (1.0 + 0.03 * rng.standard_normal(charge.shape)), rng, 1)
    assert abs(follower.film.pretension_MPa - 1.3) < 2.0 * follower.film.pretension_std_MPa


@pytest.mark.first_cases(1)
@pytest.mark.parametrize("change_MPa", [-0.3, 0.3])
def test_a_sudden_change_is_followed_after_eight_touches(series, model, change_MPa):
    """The forty touches before the change must not determine the pretension too well."""
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(2):
        _, charge_before = touches(series, [0.0, 0.7, -0.8], rng, 40)
        contact, charge = touches(series, [change_MPa, 0.7, -0.8], rng, 40)
        follower, _ = followed(model, np.concatenate([charge_before, charge[:8]]), rng, frames=4)
        errors.append(force_errors(follower, model, contact[20:], NOISE.add(charge[20:], rng)))
    rms_error, covered_share = np.mean(errors, axis=0)
    assert rms_error < 0.04
    assert covered_share > 0.85


@pytest.mark.parametrize("change_MPa", [0.3, -0.3])
def test_stated_uncertainty_contains_the_change_as_long_as_the_touches_show_little(series, model, change_MPa):
    """The estimate is drawn to that of the calibration until a change is clear, but its uncertainty is not."""
    rng = np.random.default_rng(6)
    deviations = []
    for _ in range(12):
        _, charge = touches(series, [change_MPa, 0.7, -0.8], rng, 3)
        film = followed(model, charge, rng, 1)[0].film
        deviations.append(abs(film.pretension_MPa - 1.0 - change_MPa) / film.pretension_std_MPa)
    assert np.mean(np.array(deviations) < 2.0) > 0.9


def test_a_night_without_power_makes_the_pretension_uncertain_again(series, model):
    rng = np.random.default_rng(0)
    _, charge = touches(series, [0.0, 0.0, 0.0], rng, 31)
    follower, _ = followed(model, charge[:30], rng)
    std_MPa = follower.film.pretension_std_MPa
    for host_s, is_touched in ((4e4, True), (4e4 + 0.04, False)):
        contact = model.predict(charge[30]) if is_touched else None
        follower.step(Frame(None, None, (), host_s=host_s, charge_pC=charge[30], contact=contact))
    assert 1.5 * std_MPa < follower.film.pretension_std_MPa < series.tension_std_MPa


def test_nearly_slack_film_that_has_not_changed_is_not_lost(tmp_path):
    """The pretension is 0.01 MPa and cannot become smaller."""
    rng = np.random.default_rng(2)
    slack = charge_map(-0.01, 0.0, 0.7)
    _, charge = touches(slack, np.zeros(3), rng, 60)
    _, was_lost = followed(model_in(tmp_path, slack), charge, rng, 1)
    assert not any(was_lost)


def test_touches_that_agree_determine_the_pretension_better_than_touches_of_warm_fingers(series, model):
    """The assumed errors of a touch are an upper limit. The touches themselves show how large the errors are."""
    rng = np.random.default_rng(3)
    contact, charge = touches(series, [0.3, 0.7, -0.8], rng, 80)
    warmth_pC = 10.0 * rng.standard_normal((60, 1))
    agreeing, _ = followed(model, charge[:60], rng)
    warm, _ = followed(model, charge[:60] + warmth_pC, rng)
    assert agreeing.film.pretension_std_MPa < 0.85 * warm.film.pretension_std_MPa
    for follower in (agreeing, warm):
        _, covered_share = force_errors(follower, model, contact[60:], NOISE.add(charge[60:], rng))
        assert covered_share > 0.85


def test_stage_corrects_and_flags_contacts_and_counts_a_touch_with_invalid_frames_once(series, model):
    """The records contain the estimate that the contacts were corrected for, which is that of the earlier touches."""
    rng = np.random.default_rng(1)
    _, charge = touches(series, [0.3, 0.0, 0.0], rng, 21)
    raw = model.predict(charge[20])
    stage, _ = followed(model, charge[:20], rng)
    model.validity = SimpleNamespace(flags=lambda contact: () if contact == raw else ("misfit",))
    for is_lost in (False, True):
        stage.is_lost = is_lost
        for number in range(52):
            frame = Frame(None, None, (), host_s=100.0 + 0.01 * number, is_valid=number % 20 != 10)
            if frame.is_valid and number < 50:
                frame.charge_pC = charge[20]
                frame.set_contact(raw, model.validity)
            stage.step(frame)
            assert frame.contact_flags == (("misfit",) if frame.contact else ())
            assert frame.flags == (["film"] if frame.contact and is_lost else [])
            assert frame.film.touches == 20 + is_lost
    assert stage.film.touches == 22


def test_film_that_is_lost_again_keeps_the_state_of_the_latest_touches(series, model):
    rng = np.random.default_rng(5)
    _, charge = touches(series, [0.4, 0.0, 0.0], rng, 40)
    wrong = charge[:2] * rng.uniform(0.7, 1.4, (2, 4))
    follower, was_lost = followed(model, np.concatenate([charge, wrong, charge[:10], wrong]), rng)
    assert was_lost[-1]
    assert follower.film.pretension_MPa == pytest.approx(1.4, abs=0.1)


def test_film_whose_pretension_is_at_the_end_of_the_charge_map_is_lost(series, tmp_path):
    """The largest change of the map explains the touches well enough, but the real change may be larger."""
    rng = np.random.default_rng(5)
    _, charge = touches(series, [0.32, 0.0, 0.0], rng, 40)
    _, was_lost = followed(model_in(tmp_path, charge_map(-0.3, 0.0, 0.3)), charge, rng)
    assert any(was_lost)


def test_models_that_cannot_be_followed_are_refused(series, tmp_path):
    single = replace(series, coefficients=series.coefficients[:1], node_MPa=np.zeros(1))
    with pytest.raises(ModelError, match="calibrate"):
        new_follower(model_in(tmp_path, single))
    with pytest.raises(ModelError, match="four electrodes"):
        new_follower(model_in(tmp_path, with_electrodes(series, 3)))


def test_a_bad_first_touch_does_not_mean_that_the_film_is_lost(series, model):
    rng = np.random.default_rng(0)
    _, charge = touches(series, np.zeros(3), rng, 8)
    charge[0, 1] *= 1.2
    assert not any(followed(model, charge, rng)[1])


def test_contacts_are_corrected_from_the_first_touch(series, model):
    rng = np.random.default_rng(8)
    contact, charge = touches(series, [-0.4, 0.0, 0.0], rng, 31)
    rms_before, covered_before = force_errors(new_follower(model), model, contact[1:], charge[1:])
    follower, _ = followed(model, charge[:1], rng)
    rms_after, covered_after = force_errors(follower, model, contact[1:], charge[1:])
    assert rms_after < rms_before
    assert covered_before < 0.1
    assert covered_after > 0.85


def test_only_the_frames_near_the_largest_force_are_averaged():
    peak = TouchPeak()
    for force_N in (0.2, 0.6, 1.0, 1.02, 0.98, 0.6, 0.2):
        contact = Contact(1.0, 0.0, force_N, x_std_mm=0.1, y_std_mm=0.1, force_std_N=0.01, misfit=0.5)
        peak.add_frame(contact, force_N * np.array([100.0, 50.0]))
    np.testing.assert_allclose(peak.mean_charge_pC, [100.0, 50.0])
