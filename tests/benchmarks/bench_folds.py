"""Slides across the folds of a film, followed by their charges: the table of serve/docs/tracking_results.md.

    isocharge simulate sweep three-25um-uniaxial --radius 6.5 -o presses
    isocharge train fit presses -o three-25um-uniaxial
    python tests/benchmarks/bench_folds.py --model ./three-25um-uniaxial [--slides 1000] [--rate-hz 1000] [--force 1]
        [--gain 0]

In each slide, the force rises for 30 ms, and the contact is at rest for 0.2 s. The contact then moves along a straight
line to a position beyond a fold, with a speed of 5 to 200 mm/s (uniform in the logarithm), and is at rest for another
0.2 s. The charges are simulated with `reference` noise. The gains have random errors with the standard deviation
`--gain`.

The frames after the first crossing of a fold are counted, except for the first 20 ms after each crossing. A contact is
known if the tracker reports no other possible contact.
"""

import argparse
from collections.abc import Sequence

import numpy as np
from shared import model_film, options, print_results, track_contacts

from isocharge.common.contact_domain import into_unit_domain
from isocharge.serve import Predictor
from isocharge.serve.model.charge_file import read_charge_map
from isocharge.serve.record.record import OtherContact, TrackedContact
from isocharge.serve.signal_chain.stage import Device, Setup
from isocharge.serve.tracking.tracker import Tracker, TrackRule
from isocharge.simulate import ChargeSpline, noise_model
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.train.data.contact_errors import position_error

RISE_TIME_s = 0.03
"""Time in which the force rises, s."""

REST_s = 0.2
"""Time at rest before and after the movement, s."""

WAIT_s = 0.02
"""Time after a crossing in which frames are not counted, s."""

SPEEDS_mm_per_s = (5.0, 200.0)
"""Smallest and largest speed."""

MAX_MOVEMENT_s = 1.0
"""Longest duration of a movement, s."""

MIN_MOVEMENT_mm = 2.0
"""Shortest movement, mm."""

MAP_MARGIN_mm = 2.0
"""Distance beyond the domain of the tracker up to which charges are simulated, mm."""


def sides(film: ChargeMap, contact: np.ndarray) -> np.ndarray:
    """Return the sides of the folds on which contacts (x, y, F) lie, shape (n,).

    The determinant of the derivatives changes its sign at a fold.
    """
    in_map = film.domain.to_contact(into_unit_domain(film.domain.to_unit(contact)))
    _, derivatives = film.linearised(in_map)
    return np.sign(np.linalg.det(derivatives))


def draw_slide(
    film: ChargeMap, radius: float, asked: argparse.Namespace, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw slides until one crosses a fold.

    Args:
        film: Map from contacts to charges.
        radius: Largest distance of the ends from the centre, mm.
        asked: Options of the benchmark.
        rng: Random number generator.

    Returns:
        Time of each frame, shape (n,), s, and the true contacts (x, y, F), shape (n, 3), mm and N.
    """
    min_force, _ = film.domain.force_range
    while True:
        start, end = radius * np.sqrt(rng.random(2)) * np.exp(2j * np.pi * rng.random(2))
        distance = abs(end - start)
        duration_s = distance / np.exp(rng.uniform(*np.log(SPEEDS_mm_per_s)))
        t_s = np.arange(0.0, RISE_TIME_s + 2.0 * REST_s + duration_s, 1.0 / asked.rate_hz)
        position = start + (end - start) * np.clip((t_s - RISE_TIME_s - REST_s) / duration_s, 0.0, 1.0)
        relative_force = np.minimum((t_s + 0.002) / RISE_TIME_s, 1.0) ** 1.5
        force = np.maximum(asked.force * relative_force, min_force)
        contact = np.column_stack([position.real, position.imag, force])
        is_allowed = distance > MIN_MOVEMENT_mm and duration_s < MAX_MOVEMENT_s
        if is_allowed and np.ptp(sides(film, contact)) > 0.0:
            return t_s, contact


def is_counted(t_s: np.ndarray, side: np.ndarray) -> np.ndarray:
    """Return which frames of a slide are counted, shape (n,).

    Args:
        t_s: Time of each frame, shape (n,), s.
        side: Side of the folds in each frame, shape (n,).
    """
    crossing_s = t_s[1:][np.diff(side) != 0]
    is_after_crossing = (t_s[:, None] >= crossing_s) & (t_s[:, None] < crossing_s + WAIT_s)
    return (t_s >= crossing_s[0]) & ~is_after_crossing.any(axis=1)


def contact_array(contacts: Sequence[TrackedContact | OtherContact]) -> np.ndarray:
    """Return contacts as an array (x, y, F), shape (n, 3), mm and N."""
    return np.array([(contact.x_mm, contact.y_mm, contact.force_N) for contact in contacts])


def main() -> None:
    asked = options(__doc__, slides=1000, rate_hz=1000.0, force=1.0, gain=0.0)
    predictor = Predictor(asked.model)
    rng = np.random.default_rng(asked.seed)
    noise = noise_model("reference")
    metadata = predictor.metadata
    charges = read_charge_map(predictor.folder, metadata.electrodes)
    if charges is None or not charges.is_folded:
        raise SystemExit(f"{asked.model}: no charges.npz: its map does not fold; give the model of the lines above")
    tracker = Tracker(Setup(metadata.electrodes, Device(rules={TrackRule: TrackRule()}), predictor=predictor))
    radius = charges.domain.radius
    film = ChargeSpline.of(model_film(predictor, radius + MAP_MARGIN_mm))

    slides = []
    for _ in range(asked.slides):
        t_s, truth = draw_slide(film, radius, asked, rng)
        gains = np.exp(asked.gain * rng.standard_normal(len(metadata.electrodes)))
        charge = noise.add(film.charges(truth) * gains, rng)
        tracking = track_contacts(tracker, t_s, np.stack(predictor.predict_batch(charge), axis=1), charge)
        tracked = contact_array([frame.tracked for frame in tracking])
        other = contact_array([frame.other or frame.tracked for frame in tracking])
        side = sides(film, truth)
        is_known = [frame.other is None for frame in tracking]
        is_right = sides(film, tracked) == side
        is_one_right = is_right | (sides(film, other) == side)
        columns = np.stack([is_known, is_right, is_one_right, position_error(tracked, truth)])
        slides.append(columns[:, is_counted(t_s, side)])

    is_known, is_right, is_one_right, error_mm = np.concatenate(slides, axis=1)
    known = is_known > 0.0
    results = {
        "known_percent": 100.0 * is_known.mean(),
        "right_of_known_percent": 100.0 * is_right[known].mean(),
        "right_or_listed_percent": 100.0 * is_one_right.mean(),
        "error_of_known_median_mm": float(np.median(error_mm[known])),
        "error_of_known_95_percent_mm": float(np.quantile(error_mm[known], 0.95)),
    }
    print_results("folds", asked, {"frames": len(known), "slides": results})


if __name__ == "__main__":
    main()
