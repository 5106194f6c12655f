"""The live path as a whole: virtual sensor, pseudo-terminal, pyserial, signal chain, model, records."""

from itertools import islice

import numpy as np
import pytest

from isocharge.serve import BinaryParser, Port, VirtualSensor, stream, wander
from isocharge.serve.frames.sequence import SequenceGaps

pytestmark = pytest.mark.xdist_group("clock")


def reference_noise(charge_pC, rng):
    return charge_pC + np.hypot(1.0, 0.002 * charge_pC) * rng.standard_normal(charge_pC.shape)


def follow(film, predictor, n):
    """Records of the first n frames with what was pressed, and the counters."""
    # Charges are proportional to the force: below a twentieth of a press's peak the chain would see a release.
    script = wander(seed=11, force_range_N=(0.2, 2.0))
    parser, gaps = BinaryParser(), SequenceGaps()
    with VirtualSensor(film.charges, script, noise=reference_noise) as sensor, Port(sensor.url) as port:
        records = stream(port, predictor, parser=parser, gaps=gaps)
        pairs = [(record, sensor.truth(record.seq)) for record in islice(records, n)]
        return pairs, parser.counts, gaps, sensor.withheld


def check_nothing_lost(pairs, counts, gaps, withheld):
    assert (gaps.lost, gaps.repeated, gaps.restarts, withheld) == (0, 0, 0, 0)
    assert (counts.crc_errors, counts.malformed, counts.bytes_dropped) == (0, 0, 0)
    first = pairs[0][0].seq
    assert [record.seq for record, _ in pairs] == [(first + i) % 65536 for i in range(len(pairs))]


def check_records_against_the_truth(pairs):
    tared = [(record, truth) for record, truth in pairs if record.tare_pC is not None]
    assert all(record.contact == (truth.force_N > 0.0) for record, truth in tared)
    errors = [np.hypot(r.x_mm - t.x_mm, r.y_mm - t.y_mm) * t.force_N for r, t in tared if r.contact]
    assert len(errors) > 100
    assert np.median(errors) < 0.05  # mm N: the noise of 1 pC on a lever of 20 mm


def test_live_path_for_three_seconds_at_200_Hz(film, predictor):
    pairs, *counts = follow(film, predictor, 600)
    check_nothing_lost(pairs, *counts)
    check_records_against_the_truth(pairs)
    assert [record.tare_pC is None for record, _ in pairs] == [True] * 100 + [False] * 500


@pytest.mark.slow
def test_live_path_for_sixty_seconds_at_200_Hz(film, predictor):
    pairs, *counts = follow(film, predictor, 12_000)
    check_nothing_lost(pairs, *counts)
    check_records_against_the_truth(pairs)
