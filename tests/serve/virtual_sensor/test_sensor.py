"""The virtual sensor behaves like a board: on time, whole frames, indifferent to whether anybody reads."""

import time
from functools import partial
from itertools import islice

import numpy as np
import pytest

from isocharge.common.errors import PortError, SceneError
from isocharge.serve import AutoParser, BinaryParser, Faults, Port, Script, VirtualSensor, encode_text, wander
from isocharge.serve.frames.sequence import SequenceGaps
from isocharge.serve.virtual_sensor.script import corrupt

pytestmark = pytest.mark.xdist_group("clock")


def steady(n=10, rate_Hz=200.0, force_N=1.0):
    return Script(np.zeros(n), np.zeros(n), np.full(n, force_N), rate_Hz)


def read(url, count, parser=None):
    """The next frames of a sensor."""
    parser = parser or BinaryParser()
    with Port(url, silence_s=1.0) as port:
        frames = list(islice((frame for chunk in port for frame in parser.feed(chunk.data)), count))
    return frames, parser


def test_frames_carry_script_noise_and_offset(film):
    script = Script(np.array([1.0, np.nan]), np.array([2.0, np.nan]), np.array([0.5, 0.0]), 500.0)
    noise = lambda charge_pC, rng: charge_pC + rng.integers(1, 2, charge_pC.shape)  # noqa: E731
    with VirtualSensor(film.charges, script, noise=noise, offset_pC=[10.0, 20.0, 30.0]) as sensor:
        frames, _ = read(sensor.url, 4)
    press = film.charge_pC([1.0], [2.0], [0.5])[0]
    for frame in frames:
        clean = press if frame.seq % 2 == 0 else np.zeros(3)
        np.testing.assert_allclose(frame.values, clean + np.array([11.0, 21.0, 31.0]), rtol=1e-6)
        assert frame.t_us == frame.seq * 2000


def test_rate_does_not_drift(film):
    with VirtualSensor(film.charges, steady(rate_Hz=1000.0)) as sensor:
        begin = time.perf_counter()
        frames, _ = read(sensor.url, 1000)
        end = time.perf_counter()
        sent = np.array([sensor.truth(f.seq).sent_s for f in frames])
    lateness = sent - sent[0] - np.arange(len(sent)) / 1000.0
    assert np.median(np.abs(lateness)) < 0.02  # sleeping between frames, not until deadlines, is late by 0.05 here
    assert begin - 0.1 < sent[0] < sent[-1] < end


def test_default_offset_is_small_but_not_zero(film):
    with VirtualSensor(film.charges, wander(seed=1, seconds=0.5)) as sensor:
        (frame, *_), _ = read(sensor.url, 1)
    assert 0.0 < np.abs(frame.values).max() <= 20.0


def test_truth_is_the_press(film):
    script = wander(seed=3, seconds=2.0, rate_Hz=1000.0)
    with VirtualSensor(film.charges, script) as sensor:
        frames, _ = read(sensor.url, 1200)
        for frame in frames[::100]:
            truth = sensor.truth(frame.seq)
            assert truth.force_N == script.force_N[frame.seq]
            assert truth.x_mm == pytest.approx(script.x_mm[frame.seq], nan_ok=True)
            np.testing.assert_allclose(frame.values, truth.charge_pC, atol=21.0)


def test_script_begins_again(film):
    with VirtualSensor(film.charges, steady(7, rate_Hz=1000.0)) as sensor:
        frames, _ = read(sensor.url, 30)
        assert frames[-1].seq >= 29
        assert sensor.truth(frames[-1].seq).force_N == 1.0


def test_truth_of_a_frame_to_come(film):
    with (
        VirtualSensor(film.charges, steady()) as sensor,
        pytest.raises(SceneError, match="no frame 60000 was played"),
    ):
        sensor.truth(60_000)


def test_frames_are_withheld_until_somebody_reads(film):
    """What does not fit is withheld whole: a late reader sees a gap at most, and no damaged frame."""
    with VirtualSensor(film.charges, steady(rate_Hz=2000.0)) as sensor:
        time.sleep(0.3)
        assert sensor.withheld > 100
        for _ in range(3):
            frames, parser = read(sensor.url, 200)
            gaps = SequenceGaps()
            for frame in frames:
                gaps.update(frame.seq)
            assert (parser.counts.crc_errors, parser.counts.malformed, gaps.repeated, gaps.restarts) == (0, 0, 0, 0)
        assert sensor.sent + sensor.withheld > 600


def test_sensor_plays_again_after_leaving(film):
    sensor = VirtualSensor(film.charges, steady())
    for _ in range(2):
        with sensor:
            assert read(sensor.url, 3)[0][0].seq < 100
    with pytest.raises(PortError, match="does not play"):
        sensor.url  # noqa: B018


@pytest.mark.parametrize("charges", [np.zeros(3), np.zeros((2, 3)), np.full((10, 3), np.nan)])
def test_forward_map_that_is_refused(charges):
    with pytest.raises(SceneError, match=r"forward map: expected finite charges of shape \(10, electrodes\)"):
        VirtualSensor(lambda *_: charges, steady())


@pytest.mark.parametrize("notation", ["csv", "pairs", "teleplot", "json"])
def test_sensor_sends_text(film, notation):
    encode = partial(encode_text, notation=notation)
    with VirtualSensor(film.charges, steady(), encode=encode, offset_pC=[1.0, 2.0, 3.0]) as sensor:
        frames, parser = read(sensor.url, 20, AutoParser())
    assert parser.counts.malformed <= 1  # the first line may have been cut
    np.testing.assert_allclose(frames[-1].values, film.charge_pC([0.0], [0.0], [1.0])[0] + [1.0, 2.0, 3.0], rtol=1e-6)


def test_amplifier_takes_the_script_in_order_and_over_and_over(film):
    """One with a memory: it counts the rows that it has been given."""
    seen = []

    def noise(charge_pC, _):
        first = sum(map(len, seen))
        seen.append(charge_pC)
        return charge_pC + np.arange(first, first + len(charge_pC))[:, None]

    with VirtualSensor(film.charges, steady(7, 1000.0), noise=noise, offset_pC=[0.0] * 3) as sensor:
        frames, _ = read(sensor.url, 1200)
    clean = film.charge_pC([0.0], [0.0], [1.0])[0]
    for frame in frames:
        np.testing.assert_allclose(frame.values, clean + frame.seq, rtol=1e-6)


def test_faults_are_counted(film):
    faults = Faults(lose_share=0.2, corrupt_share=0.01)
    with VirtualSensor(film.charges, steady(rate_Hz=1000.0), faults=faults, seed=4) as sensor:
        frames, parser = read(sensor.url, 400)
        gaps = SequenceGaps()
        for frame in frames:
            gaps.update(frame.seq)
        lost, corrupted = sensor.lost, sensor.corrupted
    played = len(frames) + gaps.lost
    assert lost / played == pytest.approx(0.2, abs=0.07)
    assert corrupted / played == pytest.approx(0.8 * (1 - 0.99**27), abs=0.07)
    assert parser.counts.crc_errors + parser.counts.malformed > 50
    assert all(frame.values == frames[0].values for frame in frames)


def test_gaps_come_when_asked(film):
    faults = Faults(gap_every_s=0.2, gap_s=0.1)
    with VirtualSensor(film.charges, steady(rate_Hz=500.0), faults=faults) as sensor:
        frames, _ = read(sensor.url, 150)
    assert {(frame.seq % 100) < 50 for frame in frames if frame.seq >= 100} == {False}


def test_clock_drift(film):
    with VirtualSensor(film.charges, steady(rate_Hz=1000.0), faults=Faults(clock_ppm=500.0)) as sensor:
        frames, _ = read(sensor.url, 100)
    assert frames[-1].t_us == round(frames[-1].seq * 1000.5)


def test_unplugged_port_comes_back_under_the_same_name(film):
    faults = Faults(unplug_every_s=0.8, unplug_s=0.3)
    with VirtualSensor(film.charges, steady(rate_Hz=500.0), faults=faults) as sensor:
        outages_s = []
        with Port(sensor.url, reconnect=True) as port:
            while len(outages_s) < 2:
                outages_s.append(next(chunk.outage_s for chunk in port if chunk.outage_s > 0.0))
    assert min(outages_s) > 0.2
    assert port.outages == 2


def test_corruption_flips_drops_and_adds():
    data, rng = bytes(1000), np.random.default_rng(0)
    lengths = [len(corrupt(data, 0.01, rng)) for _ in range(200)]
    assert np.mean(lengths) == pytest.approx(1000, abs=1.0)
    assert np.std(lengths) == pytest.approx(np.sqrt(1000 * 0.01 * 2 / 3), rel=0.2)
    assert corrupt(data, 0.0, rng) == data
