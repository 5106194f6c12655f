"""One press: CPU time against error, for several meshes; and what the mesh that `press` chooses does.

    python tests/benchmarks/bench_solve.py [--positions 20] [--seed 1] [--json]        (seven minutes; four with 3)

Time is the process CPU time of `press` (mesh, Newton) and `touch_charge` (readout) with imports, templates and symbolic
work done, from flat ("cold") and from a press 0.5 mm away with a tenth more force ("warm"). Errors are of each charge,
relative to itself, over all four built-in sensors, against a solve of order 10 whose electrodes are read with 60 x 60
points; so they contain the mesh and the readout, but not what the theory leaves out.
"""

import argparse
import json
import os
import platform
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from isocharge.simulate import (
    STANDARD,
    Circle,
    Equilibrium,
    Resolution,
    Sensor,
    built_in_sensors,
    load_sensor,
    press,
    touch_charge,
)
from isocharge.simulate.charge import ReadoutPoints
from isocharge.simulate.template import template

SENSORS = tuple(load_sensor(name) for name in built_in_sensors())
FILM, PROBE = SENSORS[0].film, Circle(1e-3)
REFINED = Resolution(order=10, around=8, rings=8)
RESOLUTIONS = tuple(
    Resolution(*numbers)
    for numbers in (
        (3, 8, 4), (3, 8, 6), (3, 8, 8), (3, 12, 6),
        (4, 8, 4), (4, 8, 5), (4, 8, 6), (4, 8, 8), (4, 12, 6),
        (5, 8, 4), (5, 8, 5), (5, 8, 6), (6, 8, 4), (6, 8, 6), (7, 8, 4), (7, 8, 6),
    )
)  # fmt: skip
DISTANCES_MM = (0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0, 33.0)
RADII_MM = (0.2, 0.5, 1.0, 2.0, 4.0)


@dataclass(frozen=True)
class Scene:
    """A press."""

    x: float
    y: float
    force: float

    def solve(
        self, resolution: Resolution | None = None, start: Equilibrium | None = None, probe: Circle = PROBE
    ) -> Equilibrium:
        return press(FILM, probe, (self.x, self.y), self.force, resolution=resolution, start=start)

    def neighbour(self) -> "Scene":
        return Scene(self.x + 0.3e-3, self.y - 0.4e-3, 1.1 * self.force)


def scenes(count: int, seed: int) -> tuple[list[Scene], list[Scene]]:
    """Presses uniform over r <= 10 mm and away from the electrodes (4 mm); and presses on or beside an electrode."""
    rng = np.random.default_rng(seed)
    centres = {complex(*electrode.centre) for sensor in SENSORS for electrode in sensor.electrodes}

    def draw(away: bool) -> Scene:
        while True:
            z = 12e-3 * np.sqrt(rng.random()) * np.exp(2j * np.pi * rng.random())
            nearest = min(abs(z - centre) for centre in centres)
            if (nearest > 4e-3 and abs(z) < 10e-3) if away else nearest < 2.5e-3:
                return Scene(float(z.real), float(z.imag), float(np.exp(rng.uniform(np.log(0.05), np.log(2.0)))))

    return [draw(True) for _ in range(count)], [draw(False) for _ in range(count)]


def charges(solved: Equilibrium) -> np.ndarray:
    """Of all sensors, as a user gets them."""
    return np.concatenate([touch_charge(sensor, solved) for sensor in SENSORS])


def refined_charges(solved: Equilibrium, per_side: int = 60) -> np.ndarray:
    """Of all sensors, read with many points."""

    def read(sensor: Sensor) -> np.ndarray:
        rule = ReadoutPoints.of(sensor, per_side)
        return rule.charge(solved.touch_stress(rule.points.reshape(-1, 2)).reshape(*rule.points.shape[:2], 3))

    return np.concatenate([read(sensor) for sensor in SENSORS])


def milliseconds(call: Any) -> tuple[float, Any]:
    """Process CPU time of one call, and what it returned."""
    begin = time.process_time_ns()
    result = call()
    return (time.process_time_ns() - begin) / 1e6, result


def row(resolution: Resolution, away: list[Scene], on: list[Scene], exact: dict[Scene, np.ndarray]) -> dict[str, Any]:
    """One line of the first table."""
    for scene in away[:2]:
        touch_charge(SENSORS[0], scene.solve(resolution, start=scene.neighbour().solve(resolution)))
    cold, warm, errors = [], [], {}
    for scene in away + on:
        spent, solved = milliseconds(lambda scene=scene: scene.solve(resolution))
        reading, _ = milliseconds(lambda solved=solved: touch_charge(SENSORS[0], solved))
        cold.append(spent + reading)
        errors[scene] = np.abs(charges(solved) / exact[scene] - 1.0)
        start = scene.neighbour().solve(resolution)
        spent, _ = milliseconds(lambda scene=scene, start=start: scene.solve(resolution, start=start))
        warm.append(spent + reading)
    off_probe, on_probe = (np.concatenate([errors[scene] for scene in group]) for group in (away, on))
    return {
        **asdict(resolution),
        "unknowns": 3 * template(resolution).n_free,
        "cold_ms": [float(np.median(cold)), float(np.quantile(cold, 0.95))],
        "warm_ms": [float(np.median(warm)), float(np.quantile(warm, 0.95))],
        "error_median": float(np.median(off_probe)),
        "error_worst": float(off_probe.max()),
        "error_on_electrode_median": float(np.median(on_probe)),
        "error_on_electrode_worst": float(on_probe.max()),
    }


def error_by_scene() -> Iterator[dict[str, Any]]:
    """Worst charge error of the mesh that `press` chooses, over twelve directions, at 1 N, and its estimate."""
    for radius_mm in RADII_MM:
        for distance_mm in DISTANCES_MM:
            refined = Resolution(9, 8 if distance_mm < 15.0 else 16, 8 if distance_mm < 15.0 else 10)
            probe, scene = Circle(radius_mm * 1e-3), Scene(distance_mm * 1e-3, 0.0, 1.0)
            rough, fine = scene.solve(probe=probe), scene.solve(refined, probe=probe)
            angles = np.exp(2j * np.pi * (np.arange(12) + 0.1) / 12)
            places = [(float(z.real), float(z.imag)) for z in distance_mm * 1e-3 * angles]
            worst = max(
                np.abs(charges(replace(rough, at=at)) / refined_charges(replace(fine, at=at), 24) - 1.0).max()
                for at in places
            )
            yield {
                "radius_mm": radius_mm,
                "distance_mm": distance_mm,
                **asdict(rough.resolution),
                "cold_ms": 1e3 * rough.seconds,
                "error_worst": float(worst),
                "mesh_error": rough.mesh_error,
            }


def machine() -> dict[str, str]:
    """Where a figure was measured."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    cpu = next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")
    return {
        "cpu": cpu or platform.processor(),
        "cores": str(os.cpu_count()),
        "system": platform.platform(),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }


def record(positions: int, seed: int) -> dict[str, Any]:
    """Everything that is measured."""
    away, on = scenes(positions, seed)
    exact = {scene: refined_charges(scene.solve(REFINED)) for scene in away + on}
    finer = replace(REFINED, order=11)
    check = max(np.abs(refined_charges(s.solve(finer)) / exact[s] - 1.0).max() for s in (*away[:2], *on[:2]))
    return {
        "machine": machine(),
        "positions": positions,
        "seed": seed,
        "reference_against_order_11": float(check),
        "resolutions": [row(resolution, away, on, exact) for resolution in RESOLUTIONS],
        "chosen_by_scene": list(error_by_scene()),
    }


def tables(result: dict[str, Any]) -> str:
    """The record for people."""
    lines = [
        ", ".join(f"{key} {value}" for key, value in result["machine"].items()),
        f"{result['positions']} + {result['positions']} presses (away from, on or beside an electrode), seed "
        f"{result['seed']}; the reference is true to {result['reference_against_order_11']:.0e}",
        "",
        "order around rings unknowns | cold ms median  p95 | warm ms median  p95 | error median   worst | "
        "on electrode: median   worst",
    ]
    for entry in result["resolutions"]:
        star = "  <- STANDARD" if Resolution(entry["order"], entry["around"], entry["rings"]) == STANDARD else ""
        lines.append(
            f"{entry['order']:5} {entry['around']:6} {entry['rings']:5} {entry['unknowns']:8} | "
            f"{entry['cold_ms'][0]:14.0f} {entry['cold_ms'][1]:4.0f} | "
            f"{entry['warm_ms'][0]:14.0f} {entry['warm_ms'][1]:4.0f} | "
            f"{entry['error_median']:12.1e} {entry['error_worst']:7.1e} | "
            f"{entry['error_on_electrode_median']:20.1e} {entry['error_on_electrode_worst']:7.1e}{star}"
        )
    lines += ["", "the mesh that press chooses (film radius 45 mm): order, CPU ms, worst charge, its estimate"]
    lines.append("probe radius mm | " + " | ".join(f"{distance:11g} mm           " for distance in DISTANCES_MM))
    for radius in RADII_MM:
        cells = [
            f"{e['order']} {e['cold_ms']:5.0f} {e['error_worst']:.1e} {e['mesh_error']:.1e}"
            for e in result["chosen_by_scene"]
            if e["radius_mm"] == radius
        ]
        lines.append(f"{radius:15g} | " + " | ".join(cells))
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="CPU time of one press against the error of its charges.")
    parser.add_argument("--positions", type=int, default=20, help="presses of each kind (default: 20)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    arguments = parser.parse_args()
    result = record(arguments.positions, arguments.seed)
    print(json.dumps(result) if arguments.json else tables(result))


if __name__ == "__main__":
    main()
