"""Slides across the folds of a film, followed by their charges: the table of serve/docs/tracking_results.md.

    isocharge simulate sweep three-25um-uniaxial --radius 6.5 -o presses
    isocharge train fit presses -o three-25um-uniaxial
    python tests/benchmarks/bench_folds.py --model ./three-25um-uniaxial [--slides 1000] [--rate-hz 1000]
        [--noise reference] [--force 1] [--gain 0] [--json]

In each slide, the force rises for 30 ms, and the contact is at rest for 0.2 s. The contact then moves along a straight
line to a position beyond a fold, with a speed of 5 to 200 mm/s (uniform in the logarithm), and is at rest for another
0.2 s. The charges are simulated with noise. The gains have random errors with the standard deviation `--gain`.

The frames after the first crossing of a fold are counted, except for the first 20 ms after each crossing. A contact is
known if the tracker reports no other possible contact.
"""

import argparse
from typing import NamedTuple

import numpy as np
from shared import model_film, options, print_results

from isocharge.common.contact_domain import into_unit_domain
from isocharge.serve import Contact, Predictor
from isocharge.serve.frames.frame import Frame
from isocharge.serve.model.charge_file import read_charge_map
from isocharge.serve.record.record import OtherContact, TrackedContact
from isocharge.serve.signal_chain.stage import Device, Setup
from isocharge.serve.tracking.tracker import Tracker, TrackRule
from isocharge.simulate import noise_model
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.forward.charge_spline import with_fast_derivatives

RISE_TIME_s = 0.03
"""Time in which the force rises, s."""

REST_s = 0.2
"""Time at rest before and after the movement, s."""

WAIT_s = 0.02
"""Time after a crossing in which frames are not counted, s."""

MIN_SPEED_mm_per_s = 5.0
MAX_SPEED_mm_per_s = 200.0
MAX_MOVEMENT_s = 1.0
"""Longest duration of a movement, s."""

MIN_MOVEMENT_mm = 2.0
"""Shortest movement, mm."""

MAP_MARGIN_mm = 2.0
"""Distance beyond the domain of the tracker up to which charges are simulated, mm."""


class Slide(NamedTuple):
    """A simulated slide.

    Attributes:
        t_s: Time of each frame, shape (n,), s.
        contact: True contacts (x, y, F), shape (n, 3), mm and N.
        side: Side of the folds, -1 or 1, shape (n,).
    """

    t_s: np.ndarray
    contact: np.ndarray
    side: np.ndarray


def sides(film: ChargeMap, contact: np.ndarray) -> np.ndarray:
    """Return the sides of the folds on which contacts lie, shape (n,).

    The determinant of the derivatives changes its sign at a fold.
    """
    return np.sign(np.linalg.det(film.derivatives(contact)))


def draw_slide(film: ChargeMap, radius: float, asked: argparse.Namespace, rng: np.random.Generator) -> Slide:
    """Draw slides until one crosses a fold.

    Args:
        film: Map from contacts to charges.
        radius: Largest distance of the ends from the centre, mm.
        asked: Options of the benchmark.
        rng: Random number generator.
    """
    min_force, _ = film.domain.force_range
    while True:
        start, end = radius * np.sqrt(rng.random(2)) * np.exp(2j * np.pi * rng.random(2))
        distance = abs(end - start)
        speed = np.exp(rng.uniform(np.log(MIN_SPEED_mm_per_s), np.log(MAX_SPEED_mm_per_s)))
        duration_s = distance / speed
        t_s = np.arange(0.0, RISE_TIME_s + 2.0 * REST_s + duration_s, 1.0 / asked.rate_hz)
        position = start + (end - start) * np.clip((t_s - RISE_TIME_s - REST_s) / duration_s, 0.0, 1.0)
        relative_force = np.minimum((t_s + 0.002) / RISE_TIME_s, 1.0) ** 1.5
        force = np.maximum(asked.force * relative_force, min_force)
        contact = np.column_stack([position.real, position.imag, force])
        side = sides(film, contact)
        if distance > MIN_MOVEMENT_mm and duration_s < MAX_MOVEMENT_s and (side != side[0]).any():
            return Slide(t_s, contact, side)


def is_counted(slide: Slide) -> np.ndarray:
    """Return which frames of a slide are counted, shape (n,)."""
    t_s = slide.t_s
    crossing_s = t_s[1:][np.diff(slide.side) != 0]
    is_after_crossing = (t_s[:, None] >= crossing_s) & (t_s[:, None] < crossing_s + WAIT_s)
    return (t_s >= crossing_s[0]) & ~is_after_crossing.any(axis=1)


def examine_frame(
    film: ChargeMap, tracked: TrackedContact, other: OtherContact | None, truth: np.ndarray, side: float
) -> tuple[bool, bool, bool, float]:
    """Compare the contacts that the tracker reports with the true contact.

    Args:
        film: Map from contacts to charges.
        tracked: The tracked contact.
        other: The other possible contact; None if there is none.
        truth: The true contact (x, y, F), shape (3,), mm and N.
        side: Side of the folds of the true contact.

    Returns:
        Whether the tracker reports a single contact; whether the tracked contact is on the right side of the folds;
        whether it or the other contact is on the right side; and the distance of the tracked contact from the true one,
        mm.
    """
    contacts = [contact for contact in (tracked, other) if contact is not None]
    reported = np.array([(contact.x_mm, contact.y_mm, contact.force_N) for contact in contacts])
    in_map = film.domain.to_contact(into_unit_domain(film.domain.to_unit(reported)))
    is_right_side = sides(film, in_map) == side
    error_mm = float(np.hypot(*(reported[0] - truth)[:2]))
    return other is None, bool(is_right_side[0]), bool(is_right_side.any()), error_mm


def main() -> None:
    asked = options(__doc__, slides=1000, rate_hz=1000.0, force=1.0, noise="reference", gain=0.0)
    predictor = Predictor(asked.model)
    rng = np.random.default_rng(asked.seed)
    noise = noise_model(asked.noise)
    metadata = predictor.metadata
    charges = read_charge_map(predictor.folder, metadata.electrodes)
    if charges is None or not charges.is_folded:
        raise SystemExit(f"{asked.model}: no charges.npz: its map does not fold; give the model of the lines above")
    tracker = Tracker(Setup(metadata.electrodes, Device(rules={TrackRule: TrackRule()}), predictor=predictor))
    radius = charges.domain.radius
    film = with_fast_derivatives(model_film(predictor, radius + MAP_MARGIN_mm))

    counted_frames = []
    for _ in range(asked.slides):
        slide = draw_slide(film, radius, asked, rng)
        gains = np.exp(asked.gain * rng.standard_normal(len(metadata.electrodes)))
        charge = noise.add(film.charges(slide.contact) * gains, rng)
        contacts = [Contact(*row) for row in np.asarray(predictor.predict_batch(charge)).tolist()]
        tracker.reset()
        reports = []
        for contact, t_s, frame_charge in zip(contacts, slide.t_s.tolist(), charge, strict=True):
            frame = Frame(None, None, (), clock_s=t_s, charge_pC=frame_charge, contact=contact)
            tracker.step(frame)
            reports.append((frame.tracking.tracked, frame.tracking.other))
        for number in np.flatnonzero(is_counted(slide)):
            tracked, other = reports[number]
            counted_frames.append(examine_frame(film, tracked, other, slide.contact[number], slide.side[number]))

    is_known, is_right, is_one_right, error_mm = map(np.array, zip(*counted_frames, strict=True))
    results = {
        "known_percent": 100.0 * is_known.mean(),
        "right_of_known_percent": 100.0 * is_right[is_known].mean(),
        "right_or_said_percent": 100.0 * is_one_right.mean(),
        "error_of_known_median_mm": float(np.median(error_mm[is_known])),
        "error_of_known_95_percent_mm": float(np.quantile(error_mm[is_known], 0.95)),
    }
    print_results("folds", asked, {"frames": len(counted_frames), "slides": results})


if __name__ == "__main__":
    main()
