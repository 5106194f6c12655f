"""Thousands of presses drawn from all over the scenes: does every one converge, or say why not, and how right is it?

    python tests/benchmarks/bench_hard_cases.py [--draws 2000] [--refine 60] [--seed 7] [--json]     (about an hour)

Drawn, uniform in the logarithm but where said: thickness 5 um to 2 mm, pretension 0 (40 %) or 0.01 to 20 MPa, force
1e-5 to 10 N, probe reach 0.1 to 8 mm (circle, rectangle, triangle, polygon of 4 to 8 corners, any angle), position
uniform over the area that the footprint can take (85 %) or close to the rim, Poisson's ratio uniform in 0 to 0.49. The
film has a radius of 45 mm and 3 GPa. Nothing is tuned: `press(film, probe, at, force)`, theory and mesh by itself.

The worst by their own estimate, and as many at random, are solved again with the full theory on a mesh two orders
higher; errors are of the charges of the built-in layouts, relative to the largest of a layout.
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.errors import SceneError, SolveError
from isocharge.simulate import (
    Circle,
    Equilibrium,
    Film,
    Polygon,
    Probe,
    Theory,
    load_sensor,
    press,
    touch_charge,
)

SENSORS = tuple(load_sensor(name) for name in ("three-25um-biaxial", "four-25um-uniaxial"))
RADIUS = 45e-3


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw_probe(rng: np.random.Generator) -> Probe:
    """A circle, rectangle, triangle or polygon that reaches 0.1 to 8 mm."""
    reach, kind, angle = log_uniform(rng, 1e-4, 8e-3), rng.integers(4), rng.uniform(0.0, 2.0 * np.pi)
    if kind == 0:
        return Circle(reach)
    if kind == 1:
        corner = rng.uniform(0.1, 0.7853)
        return Polygon.rectangle(2.0 * reach * np.cos(corner), 2.0 * reach * np.sin(corner), angle)
    if kind == 2:
        return Polygon.triangle(np.sqrt(3.0) * reach, angle)
    while True:
        count = int(rng.integers(4, 9))
        at = np.sort(rng.uniform(0.0, 2.0 * np.pi, count))
        gaps = np.diff(np.append(at, at[0] + 2.0 * np.pi))
        if gaps.max() < 2.5 and gaps.min() > 0.15:
            return Polygon.of(0.8 * reach * np.stack([np.cos(at), np.sin(at)], axis=1), angle)


def draw(seed: int, number: int) -> tuple[Film, Probe, tuple[float, float], float]:
    """One scene; the same for a seed and number, whatever else is drawn."""
    rng = np.random.default_rng([seed, number])
    pretension = 0.0 if rng.random() < 0.4 else log_uniform(rng, 1e4, 2e7)
    film = Film(RADIUS, log_uniform(rng, 5e-6, 2e-3), 3e9, float(rng.uniform(0.0, 0.49)), pretension)
    probe = draw_probe(rng)
    free = RADIUS - probe.reach
    distance = free * (np.sqrt(rng.random()) if rng.random() < 0.85 else 1.0 - log_uniform(rng, 1e-3, 0.2))
    turn = rng.uniform(0.0, 2.0 * np.pi)
    return film, probe, (float(distance * np.cos(turn)), float(distance * np.sin(turn))), log_uniform(rng, 1e-5, 10.0)


def charges(solved: Equilibrium) -> list[np.ndarray]:
    """Of each layout on this film."""
    return [touch_charge(replace(sensor, film=solved.film), solved) for sensor in SENSORS]


def solve(seed: int, number: int) -> dict[str, Any]:
    """One draw and what became of it."""
    film, probe, at, force = draw(seed, number)
    entry: dict[str, Any] = {
        "number": number,
        "thickness_um": film.thickness * 1e6,
        "pretension_MPa": film.pretension * 1e-6,
        "poisson": film.poisson,
        "force_N": force,
        "probe": probe.notation if len(probe.notation) < 24 else f"polygon of {len(getattr(probe, 'corners', ()))}",
        "reach_mm": probe.reach * 1e3,
        "distance_mm": 1e3 * float(np.hypot(*at)),
    }
    try:
        found = press(film, probe, at, force)
    except (SceneError, SolveError) as error:
        return {**entry, "status": type(error).__name__, "message": str(error)}
    resolution = found.resolution
    return {
        **entry,
        "status": found.status,
        "theory": found.theory.name,
        "mesh": [resolution.order, resolution.around, resolution.rings, resolution.rim],
        "iterations": found.iterations,
        "residual": found.residual,
        "estimated_error": found.estimated_error,
        "seconds": found.seconds,
    }


def refined_error(seed: int, entry: dict[str, Any]) -> float:
    """Worst error of a charge against the full theory on a finer mesh, relative to the layout's largest."""
    film, probe, at, force = draw(seed, entry["number"])
    found = press(film, probe, at, force)
    finer = replace(
        found.resolution,
        order=found.resolution.order + 2 + (not found.theory.bending),
        rings=found.resolution.rings + 1,
        rim=found.resolution.rim + 1,
    )
    full = Theory(stretching=True, bending=True, pretensioned=film.pretension > 0.0)
    exact = press(film, probe, at, force, theory=full, resolution=finer)
    return max(
        float(np.abs(rough - fine).max() / np.abs(fine).max())
        for rough, fine in zip(charges(found), charges(exact), strict=True)
    )


def record(draws: int, refine: int, seed: int, log: Path | None, first: int = 0) -> dict[str, Any]:
    """Everything that is measured; what a log already holds is not solved again."""
    entries = [json.loads(line) for line in log.read_text().splitlines()] if log and log.exists() else []
    began = time.time()
    for number in range(first + len(entries), first + draws):
        entries.append(solve(seed, number))
        if log:
            with log.open("a") as file:
                file.write(json.dumps(entries[-1]) + "\n")
        if number % 20 == 19:
            print(f"{number + 1 - first} of {draws}, {time.time() - began:.0f} s", file=sys.stderr, flush=True)
    entries = entries[:draws]
    solved = [entry for entry in entries if entry["status"] == "converged"]
    worst = sorted(solved, key=lambda entry: -entry["estimated_error"])[:refine]
    chosen = np.random.default_rng(seed).permutation(len(solved))[:refine]
    for entry in [*worst, *(solved[i] for i in chosen)]:
        try:
            entry.setdefault("error", refined_error(seed, entry))
        except (SceneError, SolveError) as error:
            entry["refined"] = str(error)
    return {"seed": seed, "draws": entries, "random": [solved[i]["number"] for i in chosen]}


def tables(result: dict[str, Any]) -> str:
    """The record for people."""
    entries = result["draws"]
    solved = [entry for entry in entries if entry["status"] == "converged"]
    lines = [f"{len(entries)} draws, seed {result['seed']}: {len(solved)} converged"]
    others = sorted({entry["status"] for entry in entries} - {"converged"})
    lines += [f"  {status}: {sum(entry['status'] == status for entry in entries)}" for status in others]
    for name in ("iterations", "residual", "seconds", "estimated_error"):
        values = np.array([entry[name] for entry in solved])
        lines.append(
            f"{name}: median {np.median(values):.3g}, 95 % {np.quantile(values, 0.95):.3g}, worst {values.max():.3g}"
        )
    theories = sorted({entry["theory"] for entry in solved})
    lines += [f"  {theory}: {sum(entry['theory'] == theory for entry in solved)}" for theory in theories]
    sample = [e for e in solved if e["number"] in set(result["random"]) and "error" in e]
    if sample:
        errors = np.array([entry["error"] for entry in sample])
        kept = np.mean([entry["error"] <= entry["estimated_error"] for entry in sample])
        lines.append(
            f"error of {len(sample)} at random: median {np.median(errors):.1e}, 95 % {np.quantile(errors, 0.95):.1e}, "
            f"worst {errors.max():.1e}; within its estimate {kept:.0%}"
        )
    header = (
        f"{'um':>6} {'MPa':>6} {'nu':>4} {'N':>8} {'reach':>5} {'at':>5} mm  {'mesh':14} steps residual estimate error"
    )
    for title, key in (("error against a refined solve", "error"), ("steps", "iterations"), ("residual", "residual")):
        lines += ["", f"worst by {title}", header]
        ranked = sorted((e for e in solved if key in e), key=lambda entry: -entry[key])[:12]
        lines += [_line(entry) for entry in ranked]
    refused = [entry for entry in entries if entry["status"] != "converged"]
    lines += ["", "no answer"] + [f"{e['number']}: {e['message']}" for e in refused]
    return "\n".join(lines)


def _line(entry: dict[str, Any]) -> str:
    mesh = ",".join(str(part) for part in entry["mesh"])
    error = f"{entry['error']:.1e}" if "error" in entry else "-"
    return (
        f"{entry['thickness_um']:6.0f} {entry['pretension_MPa']:6.2f} {entry['poisson']:4.2f} {entry['force_N']:8.1e} "
        f"{entry['reach_mm']:5.2f} {entry['distance_mm']:5.1f}     {mesh:14} {entry['iterations']:5d} "
        f"{entry['residual']:8.0e} {entry['estimated_error']:8.1e} {error}  {entry['probe']}, {entry['theory']}"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Presses drawn from all over the scenes.")
    parser.add_argument("--draws", type=int, default=2000)
    parser.add_argument("--refine", type=int, default=60, help="so many of the worst, and as many at random")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    parser.add_argument("--log", type=Path, help="write each draw to this file, and go on from there")
    parser.add_argument("--first", type=int, default=0, help="number of the first draw, to share the work")
    arguments = parser.parse_args()
    result = record(arguments.draws, arguments.refine, arguments.seed, arguments.log, arguments.first)
    print(json.dumps(result) if arguments.json else tables(result))


if __name__ == "__main__":
    main()
