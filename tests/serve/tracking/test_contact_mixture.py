"""Tests of the contact mixture on a film with a known fold: contacts at x and at 2 FOLD - x have the same charges."""

import json
import shutil

import numpy as np
import pytest
from numpy.polynomial import Polynomial, chebyshev

from isocharge.common.contact_domain import Domain
from isocharge.common.errors import ModelError
from isocharge.serve import Predictor, TouchStream, Validity
from isocharge.serve.live.device import device_from_table
from isocharge.serve.model.charge_file import charge_map_bytes
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.serve.model.contact import disk_corners
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.tracking.contact_mixture import ContactMixture
from isocharge.serve.tracking.gaussian_components import GAIN_STD
from model_files import put_charge_map
from stage_runner import new_tracker, recorded_lines
from stage_runner import track as track_frame

RADIUS = 6.0
"""Largest distance of a contact from the centre, mm."""

FOLD = 2.0
"""Position x of the fold, mm."""

FORCES = (0.05, 2.0)
"""Smallest and largest force, N."""

NOISE = ModelNoise(name="reference", white_pC=1.0, gain=0.002)

MODEL_CONTACT = (0.0,) * 10
"""Contact predicted by the model. The tracker does not use its values, because the film has a mixture."""


def charges(x, y, force):
    """Compute charges with ln(Q_1 / Q_0) = 0.1 (x - x^2 / (2 FOLD)) and ln(Q_2 / Q_0) = 0.1 y, pC."""
    folded_x = 0.1 * (x - x**2 / (2.0 * FOLD))
    return 2000.0 * (force**0.7 * np.exp([0.0 * x, folded_x, 0.1 * y])).T


def folded_series():
    """Return the function `charges` as a series."""
    domain = Domain(RADIUS, FORCES)
    coefficients = np.zeros((3, 3, 2, 3))
    coefficients[0, 0] = [[np.log(2000.0) + 0.7 * domain.centre[2]], [0.7 * domain.scale[2]]]
    folded_x = Polynomial([0.0, 0.1, -0.05 / FOLD])(Polynomial([0.0, RADIUS]))
    coefficients[:, 0, 0, 1] += chebyshev.poly2cheb(folded_x.coef)
    coefficients[0, 1, 0, 2] += 0.1 * RADIUS
    return ChargeSeries(domain=domain, electrodes=tuple("ABC"), coefficients=coefficients[None], is_folded=True)


def noisy_charges(x, gains=(1.0, 1.0, 1.0), noise=NOISE):
    """Compute noisy charges of contacts of 0.5 N at the positions (x, 1 mm).

    Args:
        x: Positions, shape (n,), mm.
        gains: Gain of each electrode.
        noise: Noise of the charges.

    Returns:
        Charges, shape (n, 3), pC.
    """
    clean = charges(x, np.full_like(x, 1.0), np.full_like(x, 0.5)) * gains
    rng = np.random.default_rng(0)
    return clean + np.sqrt(noise.variance(clean)) * rng.standard_normal(clean.shape)


def folded_mixture():
    """Return a mixture of contacts on the folded film."""
    return ContactMixture(folded_series(), NOISE, Validity(disk_corners(RADIUS), (0.0, np.inf)))


def folded_tracker():
    """Return a tracker of the folded film."""
    tracker = new_tracker()
    tracker._new_filter = folded_mixture
    return tracker


def track(x, rate_Hz=1000.0, **options):
    """Track contacts at positions x, mm; return the tracked contact and the other contact of each frame."""
    tracker = folded_tracker()
    return [
        (track_frame(tracker, MODEL_CONTACT, number / rate_Hz, (), charge_pC)[0], tracker._other)
        for number, charge_pC in enumerate(noisy_charges(x, **options))
    ]


def test_contact_at_rest_beside_a_fold_has_an_other_contact_of_equal_probability():
    """A contact rests at x = 0, so that x = 4 is equally probable. Gain errors limit the accuracy of y."""
    tracked, other = track(np.zeros(200))[-1]
    assert other.probability == pytest.approx(0.5, abs=0.1)
    assert sorted([tracked.x_mm, other.x_mm]) == pytest.approx([0.0, 2.0 * FOLD], abs=3.0 * tracked.x_std_mm)
    assert tracked.y_std_mm == pytest.approx(np.sqrt(2.0) * GAIN_STD / 0.1, rel=0.05)
    assert tracked.force_std_N / tracked.force_N == pytest.approx(GAIN_STD / 0.7, rel=0.05)


@pytest.mark.parametrize(
    ("speed", "gains"),
    [
        (20.0, (1.0, 1.0, 1.0)),
        (10.0, (1.007, 0.993, 1.0)),
        (50.0, (0.99, 1.01, 1.0)),
        (200.0, (1.0, 1.0, 1.0)),
        (200.0, (1.007, 0.993, 1.0)),
        (200.0, (0.99, 1.01, 1.0)),
    ],
)
def test_sliding_contact_is_followed_across_a_fold(speed, gains):
    """The contact begins at x = -4, which has no mirror image on the film. Gain errors displace or hide the fold.

    The contact rests for 0.2 s, slides to x = 5, and rests again.
    """
    rate_Hz = 200.0
    t = np.arange(0.0, 0.4 + 9.0 / speed, 1.0 / rate_Hz)
    x = np.clip(speed * (t - 0.2) - 4.0, -4.0, 5.0)
    results = [list(filter(None, pair)) for pair in track(x, rate_Hz, gains=gains)]
    assert len(results[20]) == 1  # before the slide

    # 0.02 s after the contact has crossed the fold, one of the reported contacts is on the right side of the fold.
    is_across = (x > FOLD) & (t > 0.22 + (FOLD + 4.0) / speed)
    is_found = [max(contact.x_mm for contact in results[number]) > FOLD for number in np.flatnonzero(is_across)]
    assert np.mean(is_found) > 0.99

    assert min(abs(contact.x_mm - x[-1]) for contact in results[-1]) < 0.3
    if gains == (1.0, 1.0, 1.0):
        assert len(results[-1]) == 1


def test_contact_that_turns_back_in_front_of_a_fold_stays_on_its_side():
    t = np.arange(0.0, 1.2, 2e-3)
    x = np.interp(t, [0.2, 0.6, 1.0], [-4.0, -0.5, -4.0])
    results = track(x, 500.0)
    _, other_at_end = results[-1]
    tracked_in_slide, _ = results[200]
    assert max(tracked.x_mm for tracked, _ in results) < FOLD
    assert other_at_end is None
    assert tracked_in_slide.vx_mm_s == pytest.approx(3.5 / 0.4, rel=0.2)


def test_charges_of_no_contact_are_not_tracked_and_saturated_frames_are_ignored():
    tracker = folded_tracker()
    for number in range(20):
        assert track_frame(tracker, MODEL_CONTACT, number / 1000.0, (), np.array([1e3, 1e6, 10.0])) == (None, None)
    assert track_frame(tracker, None, 0.05) == (None, None)

    results = [
        track_frame(tracker, MODEL_CONTACT, 0.1 + number / 1000.0, (), charge_pC)
        for number, charge_pC in enumerate(noisy_charges(np.full(30, -4.0)))
    ]
    last_tracked, _ = results[-1]
    assert [event for _, event in results if event] == ["press"]
    assert last_tracked.x_mm == pytest.approx(-4.0, abs=0.3)
    assert track_frame(tracker, MODEL_CONTACT, 0.2, ("saturated",), np.full(3, 1e5)) == (last_tracked, None)


def test_rapidly_rising_force_is_followed():
    """The force triples from frame to frame, which the motion of a contact does not explain."""
    mixture = folded_mixture()
    for number, force in enumerate([0.06, 0.2, 0.6]):
        contact, *_ = mixture.update(charges(-4.0, 1.0, force), 5e-3 * number)
        assert contact.mean[2] == pytest.approx(np.log(force), abs=0.05)


def test_frames_before_a_gap_do_not_change_the_contact_after_it():
    """At 1 kHz, a step has several frames. The charges before the gap are those of another contact."""
    before, after = noisy_charges(np.full(12, -5.0)), noisy_charges(np.full(10, -2.0))
    mixture = folded_mixture()
    for number, charge_pC in enumerate(before):
        mixture.update(charge_pC, 1e-3 * number)
    first, *_ = mixture.update(after[0], 0.4)
    contact = first.contact_after(0.0, misfit=0.0)
    assert mixture.time_s == 0.4
    assert abs(contact.x_mm + 2.0) < 3.0 * contact.x_std_mm


@pytest.fixture
def model(models, tmp_path):
    """A model with the file `charges.npz` of its film."""
    folder = shutil.copytree(models / "linear", tmp_path / "linear") / "1"
    put_charge_map(folder, charge_map_bytes(folded_series()))
    return folder


def test_records_with_track_have_the_field_other(model):
    rows = np.concatenate([np.zeros((10, 3)), noisy_charges(np.zeros(40)), np.zeros((5, 3))])
    lines = recorded_lines(Predictor(model), rows, {"track": {}})
    last = json.loads(lines[45])
    released = json.loads(lines[-1])
    tracked = last["tracked"]
    assert abs(tracked["x_mm"] + last["other"]["x_mm"] - 2.0 * FOLD) < 1.0
    for name in ("x_mm", "y_mm", "force_N"):
        assert last[name] == tracked[name]
    assert last["flags"] == []
    assert (released["tracked"], released["other"]) == (None, None)


def test_mixture_uses_the_noise_that_the_device_file_states(model):
    """With the noise of the training, a noise of 5 % would explain no contact in many frames."""
    stated = {"white_pC": 2.0, "gain": 0.05}
    noisy = noisy_charges(np.full(200, -4.0), noise=ModelNoise(name="bench", **stated))
    lines = recorded_lines(Predictor(model), np.concatenate([np.zeros((10, 3)), noisy]), {"track": {}, "noise": stated})
    tracked = [json.loads(line)["tracked"] for line in lines[30:]]
    normalised = [(contact["x_mm"] + 4.0) / contact["x_std_mm"] for contact in tracked]
    assert np.sqrt(np.mean(np.square(normalised))) < 1.5


def test_stream_keeps_its_model_if_the_charges_npz_of_the_next_model_is_damaged(model, models):
    first = Predictor(models / "linear")
    stream = TouchStream(first, device_from_table({"track": {}}, "b"))
    put_charge_map(model, b"damaged")
    with pytest.raises(ModelError, match=r"charges\.npz"):
        stream.use(Predictor(model))
    assert stream.predictor is first
