"""Contacts followed across a fold whose mirror is known: x and 2 FOLD - x have the same charges."""

import json
import re
import shutil

import numpy as np
import pytest
from numpy.polynomial import Polynomial, chebyshev

from isocharge.common.errors import ModelError
from isocharge.common.files import sha256_of
from isocharge.serve import Chunk, Frame, Predictor, TouchStream, encode_frame
from isocharge.serve.live.device import device_from_table
from isocharge.serve.model.charge_series import ChargeSeries, Series, read_charges
from isocharge.serve.model.metadata import ModelNoise
from isocharge.serve.tracking.branches import GAIN, Branches
from isocharge.serve.tracking.tracker import Tracker

RADIUS, FOLD, FORCES = 6.0, 2.0, (0.05, 2.0)
NOISE = ModelNoise(name="reference", white_pC=1.0, gain=0.002)


def charges(x, y, force):
    """ln Q_1 - ln Q_0 = 0.1 (x - x^2 / (2 FOLD)) and ln Q_2 - ln Q_0 = 0.1 y; pC."""
    along = 0.1 * (x - x**2 / (2.0 * FOLD))
    return 2000.0 * (force**0.7 * np.exp([0.0 * x, along, 0.1 * y])).T


def folded():
    """The same as a series."""
    coefficients = np.zeros((3, 3, 2, 3))
    half, middle = 0.5 * np.diff(np.log(FORCES))[0], np.log(FORCES).mean()
    coefficients[0, 0, :, :] = np.array([[np.log(2000.0) + 0.7 * middle], [0.7 * half]])
    along = Polynomial([0.0, 0.1, -0.05 / FOLD])(Polynomial([0.0, RADIUS]))
    coefficients[:, 0, 0, 1] += chebyshev.poly2cheb(along.coef)
    coefficients[0, 1, 0, 2] += 0.1 * RADIUS
    return ChargeSeries(Series(coefficients), RADIUS, FORCES)


def readings(x, y=1.0, force=0.5, seed=0, gains=(1.0, 1.0, 1.0)):
    """Noisy charges of places x, shape (n,), mm, to (n, 3)."""
    clean, rng = charges(x, y + 0.0 * x, force + 0.0 * x) * gains, np.random.default_rng(seed)
    return clean + np.sqrt(NOISE.variance(clean)) * rng.standard_normal(clean.shape)


def followed(x, rate_Hz=1000.0, **options):
    """What a tracker says, and what other contact, of each frame."""
    tracker = Tracker(branches=Branches(folded(), NOISE))
    return [
        (tracker.update(ANY, k / rate_Hz, (), row)[0], tracker.other) for k, row in enumerate(readings(x, **options))
    ]


ANY = (0.0,) * 10
"""The answer of a model that knows one side alone: not asked for."""


def test_the_series_is_the_map_and_beyond_its_forces_a_power():
    contact = np.array([[3.0, -2.0, 0.5], [-5.0, 1.0, 0.01], [0.0, 0.0, 4.0]])
    charge, slopes = folded().linearised(np.column_stack([contact[:, :2], np.log(contact[:, 2])]))
    assert np.allclose(charge, charges(*contact.T), rtol=1e-12)
    assert np.allclose(slopes[:, :, 2], 0.7 * charge, rtol=1e-12)
    assert np.allclose(slopes[:, 1, 0], 0.1 * (1.0 - contact[:, 0] / FOLD) * charge[:, 1], rtol=1e-12)


def test_where_charges_alone_do_not_tell_both_are_said():
    """At rest at x = 0: x = 4 is as probable, and gains alone, whose deviations do not average out, leave y unknown."""
    tracked, other = followed(np.zeros(200))[-1]
    assert other.probability == pytest.approx(0.5, abs=0.1)
    assert sorted([tracked.x_mm, other.x_mm]) == pytest.approx([0.0, 2.0 * FOLD], abs=3.0 * tracked.x_std_mm)
    assert tracked.y_std_mm == pytest.approx(np.sqrt(2.0) * GAIN / 0.1, rel=0.05)
    assert tracked.force_std_N / tracked.force_N == pytest.approx(GAIN / 0.7, rel=0.05)


@pytest.mark.parametrize("rate_Hz", [200.0, 1000.0])
@pytest.mark.parametrize("speed", [10.0, 50.0, 200.0])
@pytest.mark.parametrize("gains", [(1.0, 1.0, 1.0), (1.007, 0.993, 1.0), (0.99, 1.01, 1.0)])
def test_a_contact_that_moves_on_is_followed_across(rate_Hz, speed, gains):
    """From x = -4, whose mirror no film has; gains that are off move the fold, and hide it or end the charges short."""
    t = np.arange(0.0, 0.4 + 9.0 / speed, 1.0 / rate_Hz)
    x = np.clip(speed * (t - 0.2), 0.0, 9.0) - 4.0
    said = followed(x, rate_Hz, gains=np.array(gains))
    assert said[int(0.1 * rate_Hz)][1] is None
    after = [one for one, at, true in zip(said, t, x, strict=True) if true > FOLD and at > 0.22 + (FOLD + 4.0) / speed]
    right = [tracked.x_mm > FOLD or (other is not None and other.x_mm > FOLD) for tracked, other in after]
    assert np.mean(right) > 0.99
    ends = [abs(one.x_mm - x[-1]) for one in said[-1] if one is not None]
    assert min(ends) < 0.3
    assert len(ends) == 1 or gains != (1.0, 1.0, 1.0)


def test_a_contact_that_turns_back_stays_on_its_side():
    t = np.arange(0.0, 1.2, 1e-3)
    x = np.interp(t, [0.2, 0.6, 1.0], [-4.0, -0.5, -4.0])
    said = followed(x)
    assert max(tracked.x_mm for tracked, _ in said) < FOLD
    assert said[-1][1] is None
    assert said[400][0].vx_mm_s == pytest.approx(3.5 / 0.4, rel=0.2)


def test_charges_that_no_contact_has_are_no_contact():
    tracker = Tracker(branches=Branches(folded(), NOISE))
    for k in range(20):
        assert tracker.update(ANY, k / 1000.0, (), np.array([1e3, 1e6, 10.0])) == (None, None)
    assert tracker.update(None, 0.05) == (None, None)
    found = [tracker.update(ANY, 0.1 + k / 1000.0, (), row) for k, row in enumerate(readings(np.full(30, -4.0)))]
    assert [event for _, event in found if event] == ["press"]
    assert found[-1][0].x_mm == pytest.approx(-4.0, abs=0.3)
    assert tracker.update(ANY, 0.2, ("saturated",), np.full(3, 1e5)) == (found[-1][0], None)


@pytest.fixture
def model(models, tmp_path):
    """A model with its film's charges beside it."""
    folder = shutil.copytree(models / "linear", tmp_path / "linear") / "1"
    put_charges(folder, folded().to_bytes())
    return folder


def put_charges(folder, data):
    """Write `charges.npz` beside a model, and its checksum into `golden.json`, as `write_model` does."""
    (folder / "charges.npz").write_bytes(data)
    golden = json.loads((folder / "golden.json").read_text("utf-8"))
    golden["files"] = {"charges.npz": sha256_of(data)}
    (folder / "golden.json").write_text(json.dumps(golden), "utf-8")


def test_records_say_the_other_contact_and_repeat_bit_for_bit(model):
    rows = np.concatenate([np.zeros((10, 3)), readings(np.zeros(40)), np.zeros((5, 3))])
    chunks = [
        Chunk(encode_frame(Frame(k, 1000 * k, tuple(row))), 5.0 + 1e-3 * k, 0) for k, row in enumerate(rows.tolist())
    ]
    predictor = Predictor(model)

    def lines(**memory):
        device = device_from_table({"tare": {"frames": 10}, "track": {}} | memory, "b")
        touch = TouchStream(predictor, device, now_ns=lambda: 0)
        return [record.to_json() for chunk in chunks for record in touch.feed(chunk)]

    first = lines()
    assert first == lines()
    last, released = json.loads(first[45]), json.loads(first[-1])
    assert abs(last["tracked"]["x_mm"] + last["other"]["x_mm"] - 2.0 * FOLD) < 1.0
    assert [last[name] for name in ("x_mm", "y_mm", "force_N")] == list(last["tracked"].values())[:3]
    assert last["flags"] == []
    assert (released["tracked"], released["other"]) == (None, None)
    doubted = json.loads(lines(memory={"creep": 0.08, "thermoelastic": 0.06})[45])
    for contact, sure in ((doubted, last), (doubted["tracked"], last["tracked"])):
        assert 1.1 < contact["force_std_N"] / sure["force_std_N"] < 3.0


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda data: data[:200], "zip"),
        (lambda data: data[::-1], "zip"),
        (lambda data: re.sub(rb"(PK\x01\x02.{4})\0", rb"\g<1>" b"\x01", data, flags=re.DOTALL), "encrypted"),
        (
            lambda _: ChargeSeries(Series(np.zeros((3, 3, 2, 4))), 6.0, FORCES).to_bytes(),
            r"shape \(n, n, n, 3\), got \(3, 3, 2, 4\)",
        ),
        (lambda _: ChargeSeries(Series(np.full((3, 3, 2, 3), np.nan)), 6.0, FORCES).to_bytes(), "finite"),
        (lambda _: ChargeSeries(folded().series, 6.0, (2.0, 1.0)).to_bytes(), "got 2 and 1 N"),
    ],
)
def test_a_damaged_file_of_charges_is_refused(model, spoil, message):
    put_charges(model, spoil(folded().to_bytes()))
    with pytest.raises(ModelError, match=rf"charges\.npz: .*({message}).*train again"):
        read_charges(model, 3)
