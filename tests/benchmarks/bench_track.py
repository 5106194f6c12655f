"""Contacts followed in time, by isocharge and by other filters: tables and picture of serve/docs/tracking_results.md.

    python tests/benchmarks/bench_track.py [--model NAME|PATH] [--paths 40] [--rate-hz 1000] [--noise reference]
        [--force 1] [--plot FILE] [--json]

A contact at rest, then at a speed for 0.3 s or 8 mm, then at rest, at random places of the inner working area; charges
of the simulator with noise, answers of the model. Moving average, 1 euro filter (Casiez et al. 2012; its
authors' rule: the cutoff at rest first, then beta, each scene of its own) and plain Kalman filter (constant velocity,
the best white acceleration of each scene) get their best setting for each scene; ours has one for all.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from shared import options, print_results

from isocharge.serve import Contact, Predictor
from isocharge.serve.tracking.tracker import Tracker
from isocharge.simulate import Circle, ForwardMap, noise_model
from isocharge.simulate.plots.figure import new_figure
from isocharge.simulate.sensor.sensor_file import sensor_from_dict

SPEEDS = (0.0, 5.0, 10.0, 20.0, 50.0, 100.0, 200.0)
REST_S, MOST_S, MOST_MM = 0.3, 0.3, 8.0
SETTLED_S = 0.05
"""Time after the press from which errors count, s."""

Smooth = Callable[[np.ndarray], np.ndarray]
"""Places (paths, frames), complex, mm, to smoothed ones."""


def average(count: int) -> Smooth:
    """The mean of so many frames."""

    def smooth(z: np.ndarray) -> np.ndarray:
        total = np.concatenate([np.zeros((len(z), 1)), np.cumsum(z, axis=1)], axis=1)
        ends = np.arange(1, z.shape[1] + 1)
        starts = np.maximum(ends - count, 0)
        return (total[:, ends] - total[:, starts]) / (ends - starts)

    return smooth


def one_euro(cutoff_Hz: float, beta: float, dt: float) -> Smooth:
    """Casiez, Roussel, Vogel 2012, algorithms 1 and 2, with the speed of the plane."""

    def share(cutoff: np.ndarray | float) -> np.ndarray | float:
        return 1.0 / (1.0 + 1.0 / (2.0 * np.pi * cutoff * dt))

    def smooth(z: np.ndarray) -> np.ndarray:
        out, speed = z.copy(), np.zeros(len(z), complex)
        for k in range(1, z.shape[1]):
            speed += share(1.0) * ((z[:, k] - out[:, k - 1]) / dt - speed)
            out[:, k] = out[:, k - 1] + share(cutoff_Hz + beta * np.abs(speed)) * (z[:, k] - out[:, k - 1])
        return out

    return smooth


def kalman(density: float, std: float, dt: float) -> Smooth:
    """Constant velocity, white acceleration of this density, mm^2/s^3."""

    def smooth(z: np.ndarray) -> np.ndarray:
        out, velocity, a, b, c = z.copy(), np.zeros(len(z), complex), std**2, 0.0, 1600.0
        for k in range(1, z.shape[1]):
            a, b = a + dt * (2 * b + dt * c) + density * dt**3 / 3, b + dt * c + density * dt**2 / 2
            c += density * dt
            expected, total = out[:, k - 1] + velocity * dt, a + std**2
            error = z[:, k] - expected
            out[:, k], velocity = expected + a / total * error, velocity + b / total * error
            a, b, c = a * (1 - a / total), b * (1 - a / total), c - b * b / total
        return out

    return smooth


def paths(speed: float, count: int, dt: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """True places (count, frames), complex, mm, and when they move, (frames,)."""
    last = min(MOST_S, MOST_MM / speed) if speed else MOST_S
    t = np.arange(0.0, 2.0 * REST_S + last, dt)
    middle = 2.0 * np.sqrt(rng.random(count)) * np.exp(2j * np.pi * rng.random(count))
    along = np.exp(2j * np.pi * rng.random(count))[:, None]
    way = speed * (np.clip(t - REST_S, 0.0, last) - 0.5 * last)
    return middle[:, None] + along * way, (t > REST_S) & (t < REST_S + last)


def ours(answers: list[list[Contact]], dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Places and deviations of x and y, (paths, frames, 2)."""
    places, stds = [], []
    for path in answers:
        tracker = Tracker()
        found = [tracker.update(one, k * dt)[0] for k, one in enumerate(path)]
        places.append([complex(one.x_mm, one.y_mm) for one in found])
        stds.append([(one.x_std_mm, one.y_std_mm) for one in found])
    return np.array(places), np.array(stds)


def scene(asked: argparse.Namespace, touch: Predictor, film: ForwardMap, speed: float) -> dict[str, float]:
    """Errors (rms of the distance, mm), lags (ms) and coverage at one speed."""
    dt, rng = 1.0 / asked.rate_hz, np.random.default_rng([asked.seed, int(speed)])
    true, moves = paths(speed, asked.paths, dt, rng)
    contact = np.stack([true.real, true.imag, np.full(true.shape, asked.force)], axis=-1).reshape(-1, 3)
    columns = np.stack(touch.predict_batch(noise_model(asked.noise).add(film.charges(contact), rng)), axis=1)
    table = columns.astype(float).reshape(*true.shape, -1)
    answers = [[Contact(*row) for row in path] for path in table.tolist()]
    raw, std = table[..., 0] + 1j * table[..., 1], float(np.median(table[..., 3:5]))
    settled = np.arange(true.shape[1]) * dt > SETTLED_S

    def error(places: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.abs(places - true)[:, settled] ** 2)))

    at_rest = true[:, :1] + raw - true
    trembles = {float(f): np.std(one_euro(f, 0.0, dt)(at_rest)[:, settled]) for f in np.geomspace(0.5, 50.0, 8)}
    quiet = min(trembles, key=lambda cutoff_Hz: abs(trembles[cutoff_Hz] - std / 3.0))
    rivals = {
        "moving average": [average(count) for count in range(1, 60, 2)],
        "1 euro": [one_euro(quiet, beta, dt) for beta in np.geomspace(0.01, 10.0, 10)],
        "plain Kalman": [kalman(density, std, dt) for density in np.geomspace(10.0, 1e6, 11)],
    }
    smoothed = {name: min((smooth(raw) for smooth in ways), key=error) for name, ways in rivals.items()}
    began = time.thread_time()
    places, stds = ours(answers, dt)
    step_us = (time.thread_time() - began) / true.size * 1e6
    row: dict[str, float] = {"speed_mm_s": speed, "force_N": asked.force, "ours_step_us": step_us}
    for name, found in {"none": raw, **smoothed, "ours": places}.items():
        row[f"{name}_mm"] = error(found)
        if speed:
            along = (true[:, -1] - true[:, 0]) / np.abs(true[:, -1] - true[:, 0])
            row[f"{name}_lag_ms"] = float(-1e3 * np.mean(((found - true) / along[:, None]).real[:, moves]) / speed)
    held = settled & (np.arange(true.shape[1]) * dt < REST_S)
    row["ours_jitter_mm"] = float(np.sqrt(np.mean(np.var(places[:, held], axis=1)) / 2.0))
    off = np.stack([places.real - true.real, places.imag - true.imag], axis=-1) / stds
    correlation = table[..., 7]
    squares = ((off**2).sum(-1) - 2 * correlation * off[..., 0] * off[..., 1]) / (1 - correlation**2)
    row["ours_95_held"], row["ours_95"] = (float(np.mean(squares[:, which] < 5.991)) for which in (held, settled))
    return row


def draw(rows: list[dict[str, float]], path: Path) -> None:
    """Error against lag, a line for each way and a point for each speed."""
    figure = new_figure(7.0, 4.5)
    axes = figure.add_subplot()
    for name in ("none", "moving average", "1 euro", "plain Kalman", "ours"):
        moving = [row for row in rows if row["speed_mm_s"]]
        lags = [row[f"{name}_lag_ms"] for row in moving]
        axes.plot(lags, [row[f"{name}_mm"] for row in moving], "o-", label=name, ms=4)
    axes.set(xlabel="mean lag of a slide, ms", ylabel="error, rms, mm", title="slides of 5 to 200 mm/s")
    axes.legend()
    figure.savefig(path, dpi=120)


def main() -> None:
    asked = options(__doc__, paths=40, rate_hz=1000.0, force=1.0, noise="reference", plot=None)
    touch = Predictor(asked.model)
    about = touch.metadata
    film = ForwardMap.build(sensor_from_dict(dict(about.sensor)), Circle(1.0), 8.0, about.force_range_N)
    rows = [scene(asked, touch, film, speed) for speed in SPEEDS]
    if asked.plot:
        draw(rows, asked.plot)
    print_results("track", asked, {"slides": rows})


if __name__ == "__main__":
    main()
