"""Slides across the folds of a film, followed by their charges: the table of serve/docs/tracking_results.md.

    isocharge simulate sweep three-25um-uniaxial --radius 6.5 -o presses
    isocharge train fit presses -o three-25um-uniaxial
    python tests/benchmarks/bench_folds.py --model ./three-25um-uniaxial [--slides 1000] [--rate-hz 1000]
        [--noise reference] [--force 1] [--gain 0] [--json]

A press of 30 ms, at rest for 0.2 s, straight on at one of 5 to 200 mm/s (uniform in the logarithm) to a place beyond a
fold, at rest for 0.2 s; charges of the simulator with noise, each electrode's gain off by `--gain` (a standard
deviation). Frames count from the first crossing on, but for the 20 ms after each. A contact is known where no other is
said beside it.
"""

import argparse
import time

import numpy as np
from shared import options, print_results

from isocharge.serve import Contact, Predictor
from isocharge.serve.tracking.contact_mixture import contact_mixture
from isocharge.serve.tracking.tracker import Tracker
from isocharge.simulate import Circle, ForwardMap, noise_model
from isocharge.simulate.forward.charge_map import ChargeMap
from isocharge.simulate.forward.charge_spline import with_fast_derivatives
from isocharge.simulate.sensor.sensor_file import sensor_from_dict

PRESS_S, REST_S, WAIT_S = 0.03, 0.2, 0.02
SLOWEST, FASTEST, LONGEST_S, SHORTEST_MM = 5.0, 200.0, 1.0, 2.0
BEYOND_MM = 2.0


def sides(film: ChargeMap, contact: np.ndarray) -> np.ndarray:
    """On which side of the folds contacts (n, 3) are: -1 or 1, shape (n,)."""
    return np.sign(np.linalg.det(film.derivatives(contact)))


def slide(
    film: ChargeMap, radius: float, asked: argparse.Namespace, rng: np.random.Generator
) -> tuple[np.ndarray, ...]:
    """Times (n,), s, contacts (n, 3) and their sides (n,), of a slide within a radius, mm, that crosses a fold."""
    while True:
        start, end = radius * np.sqrt(rng.random(2)) * np.exp(2j * np.pi * rng.random(2))
        lasts_s = abs(end - start) / np.exp(rng.uniform(np.log(SLOWEST), np.log(FASTEST)))
        t = np.arange(0.0, PRESS_S + 2.0 * REST_S + lasts_s, 1.0 / asked.rate_hz)
        place = start + (end - start) * np.clip((t - PRESS_S - REST_S) / lasts_s, 0.0, 1.0)
        force = np.maximum(asked.force * np.minimum((t + 0.002) / PRESS_S, 1.0) ** 1.5, film.domain.force_range[0])
        contact = np.column_stack([place.real, place.imag, force])
        side = sides(film, contact)
        if abs(end - start) > SHORTEST_MM and lasts_s < LONGEST_S and (side != side[0]).any():
            return t, contact, side


def counted(t: np.ndarray, side: np.ndarray) -> np.ndarray:
    """The frames after the first crossing, but for the first ones after each."""
    crossed = t[1:][np.diff(side) != 0]
    return (t >= crossed[0]) & ~((t[:, None] >= crossed) & (t[:, None] < crossed + WAIT_S)).any(axis=1)


def main() -> None:
    asked = options(__doc__, slides=1000, rate_hz=1000.0, force=1.0, noise="reference", gain=0.0)
    touch, rng, noise = Predictor(asked.model), np.random.default_rng(asked.seed), noise_model(asked.noise)
    about = touch.metadata
    mixture = contact_mixture(touch)
    if mixture is None:
        raise SystemExit(f"{asked.model}: no charges.npz: its map does not fold; give the model of the lines above")
    tracker = Tracker(mixture=mixture)
    radius = mixture.charges.radius_mm
    forces = about.force_range_N
    sensor = sensor_from_dict(dict(about.sensor))
    film = with_fast_derivatives(ForwardMap.build(sensor, Circle(1.0), radius + BEYOND_MM, forces))
    rows, steps_s, frames = [], 0.0, 0
    for _ in range(asked.slides):
        t, contact, side = slide(film, radius, asked, rng)
        gains = np.exp(asked.gain * rng.standard_normal(len(about.electrodes)))
        charge, found = noise.add(film.charges(contact) * gains, rng), []
        answers = [Contact(*row) for row in np.asarray(touch.predict_batch(charge)).tolist()]
        tracker.reset()
        began = time.thread_time()
        for answer, t_s, row in zip(answers, t.tolist(), charge, strict=True):
            found.append((tracker.update(answer, t_s, (), row)[0], tracker.other))
        steps_s, frames = steps_s + time.thread_time() - began, frames + len(t)
        for k in np.flatnonzero(counted(t, side)):
            tracked, other = found[k]
            said = np.array([one[:3] for one in (tracked, other) if one is not None])
            said[:, 2] = np.clip(said[:, 2], *forces)
            said[:, :2] *= np.minimum((radius + BEYOND_MM) / np.hypot(*said[:, :2].T), 1.0)[:, None]
            right = sides(film, said) == side[k]
            rows.append(
                (
                    other is None,
                    right[0],
                    right.any(),
                    np.hypot(tracked.x_mm - contact[k, 0], tracked.y_mm - contact[k, 1]),
                )
            )
    known, right, said, error = np.array(rows, dtype=float).T
    results = {
        "known_percent": 100.0 * known.mean(),
        "right_percent": 100.0 * right.mean(),
        "right_of_known_percent": 100.0 * right[known == 1.0].mean(),
        "right_or_said_percent": 100.0 * said.mean(),
        "error_of_known_median_mm": float(np.median(error[known == 1.0])),
        "error_of_known_95_percent_mm": float(np.quantile(error[known == 1.0], 0.95)),
        "step_us": steps_s / frames * 1e6,
    }
    print_results("folds", asked, {"frames": len(rows), "slides": results})


if __name__ == "__main__":
    main()
