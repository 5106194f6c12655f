"""Convergence and accuracy of solves for thousands of random presses.

    python tests/benchmarks/bench_hard_cases.py [--draws 2000] [--seed 7] [--jobs 2] [--json]     (some hours of CPU)

The film has a radius of 45 mm and a Young's modulus of 3 GPa. The other values are drawn at random, uniformly in the
logarithm unless stated otherwise:

- thickness from 5 um to 2 mm, and Poisson's ratio from 0 to 0.49 (uniform);
- pretension 0 (40 % of the films), or 0.01 to 20 MPa;
- force from 1e-5 to 10 N;
- a circle, rectangle, triangle or polygon of 4 to 8 corners with any rotation, which reaches 0.1 to 8 mm;
- position uniform over the area that the probe can reach (85 %), or close to the rim.

Theory and mesh are those that `press(film, probe, at, force)` chooses. Every thirtieth press, and every press with an
estimated error above 0.1 %, is solved again with the full theory on a mesh whose order is higher by two. The errors are
those of the charges of two built-in layouts, relative to the largest charge of a layout.
"""

import json
import multiprocessing
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from isocharge.common.errors import SceneError, SolveError
from isocharge.common.progress import track
from isocharge.simulate import (
    Circle,
    Equilibrium,
    Film,
    Polygon,
    Probe,
    SolveSettings,
    Theory,
    load_sensor,
    press,
    touch_charge,
)
from isocharge.simulate.mechanics.theory import ACCURACY
from isocharge.simulate.solver.error_estimate import estimated_error

SENSORS = tuple(load_sensor(name) for name in ("three-25um-biaxial", "four-25um-uniaxial"))
REFINED_STRIDE = 30
"""Distance of the numbers of the presses that are always solved again."""

TASKS_PER_PROCESS = 20
"""Number of presses after which a process is replaced, because the templates of the largest meshes need gigabytes."""


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number that is uniformly distributed in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw_probe(rng: np.random.Generator) -> Probe:
    """Draw a circle, rectangle, triangle or polygon that reaches 0.1 to 8 mm."""
    reach = log_uniform(rng, 0.1, 8.0)
    kind = rng.integers(4)
    rotation = rng.uniform(0.0, 2.0 * np.pi)
    if kind == 0:
        return Circle(reach)
    if kind == 1:
        diagonal_angle = rng.uniform(0.1, 0.7853)
        length = 2.0 * reach * np.cos(diagonal_angle)
        width = 2.0 * reach * np.sin(diagonal_angle)
        return Polygon.rectangle(length, width, rotation)
    if kind == 2:
        return Polygon.triangle(np.sqrt(3.0) * reach, rotation)
    gaps = rng.uniform(0.3, 1.0, rng.integers(4, 9))
    angle = 2.0 * np.pi * np.cumsum(gaps) / gaps.sum()
    corners = 0.8 * reach * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return Polygon.of(corners, rotation)


def draw(seed: int, number: int) -> tuple[Film, Probe, tuple[float, float], float]:
    """Draw a press: film, probe, position, mm, and force, N. It depends on the seed and the number only."""
    rng = np.random.default_rng([seed, number])
    pretension = 0.0 if rng.random() < 0.4 else log_uniform(rng, 0.01, 20.0)
    thickness = log_uniform(rng, 0.005, 2.0)
    poisson = float(rng.uniform(0.0, 0.49))
    film = Film(45.0, thickness, 3000.0, poisson, pretension)
    probe = draw_probe(rng)
    largest_distance = film.radius - probe.reach
    if rng.random() < 0.85:
        distance = largest_distance * np.sqrt(rng.random())
    else:
        distance = largest_distance * (1.0 - log_uniform(rng, 1e-3, 0.2))
    position = distance * np.exp(2j * np.pi * rng.random())
    force = log_uniform(rng, 1e-5, 10.0)
    return film, probe, (float(position.real), float(position.imag)), force


def solve(seed_and_number: tuple[int, int]) -> dict[str, Any]:
    """Solve a press, and return its description, status, and estimated and true error."""
    film, probe, at, force = draw(*seed_and_number)
    _, number = seed_and_number
    scene = f"{film.thickness:.4g} mm, {film.pretension:.3g} MPa, {probe.notation[:24]}"
    entry: dict[str, Any] = {"number": number, "scene": f"{scene}, {np.hypot(*at):.3g} mm out, {force:.2g} N"}
    try:
        solved = press(film, probe, at, force)
    except (SceneError, SolveError) as error:
        return {**entry, "status": type(error).__name__, "message": str(error)}
    entry |= {name: getattr(solved, name) for name in ("status", "iterations", "residual", "seconds")}
    entry |= {"theory": solved.theory.name, "estimate": estimated_error(solved)}
    if number % REFINED_STRIDE == 0 or entry["estimate"] > ACCURACY:
        try:
            entry["error"] = refined_error(solved)
        except (SceneError, SolveError) as error:
            entry["message"] = str(error)
    return entry


def refined_error(solved: Equilibrium) -> float:
    """Return the largest error of a charge compared with the full theory on a finer mesh.

    The error is relative to the largest charge of a layout.
    """
    film = solved.film
    mesh = solved.mesh.resolution
    finer = replace(mesh, order=mesh.order + 2, rings=mesh.rings + 1, rim=mesh.rim + 1)
    full = Theory(bending=True)
    refined = press(film, solved.probe, solved.at, solved.force, SolveSettings(theory=full, resolution=finer))
    errors = []
    for sensor in SENSORS:
        sensor_on_film = replace(sensor, film=film)
        expected = touch_charge(sensor_on_film, refined)
        difference = touch_charge(sensor_on_film, solved) - expected
        errors.append(float(np.abs(difference).max() / np.abs(expected).max()))
    return max(errors)


def solve_all(draws: int, seed: int, jobs: int) -> list[dict[str, Any]]:
    """Solve all presses in several processes."""
    tasks = [(seed, number) for number in range(draws)]
    with multiprocessing.get_context("spawn").Pool(jobs, maxtasksperchild=TASKS_PER_PROCESS) as workers:
        return list(track(workers.imap(solve, tasks), "draws", draws))


def tables(entries: list[dict[str, Any]]) -> str:
    """Return the results as text."""
    converged = [entry for entry in entries if entry["status"] == "converged"]
    lines = [f"{len(entries)} draws: {Counter(entry['status'] for entry in entries)}"]
    for name in ("iterations", "residual", "seconds", "estimate"):
        median, high, worst = np.quantile([entry[name] for entry in converged], [0.5, 0.95, 1.0])
        lines.append(f"{name}: median {median:.3g}, 95 % {high:.3g}, worst {worst:.3g}")
    refined = [entry for entry in converged if "error" in entry]
    within_count = sum(entry["error"] <= entry["estimate"] for entry in refined)
    lines.append(f"solved again: {len(refined)}, error within its estimate: {within_count}")
    lines += ["", "no answer"]
    lines += [f"{entry['number']}: {entry['message']}" for entry in entries if entry["status"] != "converged"]
    return "\n".join(lines)


def main() -> None:
    from shared import arguments  # a test imports this module from another folder, where `shared` is not found

    asked = arguments(__doc__, draws=2000, seed=7, json=False, jobs=2)
    entries = solve_all(asked.draws, asked.seed, asked.jobs)
    print(json.dumps({"seed": asked.seed, "draws": entries}) if asked.json else tables(entries))


if __name__ == "__main__":
    main()
