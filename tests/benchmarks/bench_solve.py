"""One press: CPU time against error, for several meshes, without and with bending.

    python tests/benchmarks/bench_solve.py [--positions 20] [--seed 1] [--json] [--plot FILE.png]       (ten minutes)

Time is the process CPU time of `press` (mesh, Newton) and `touch_charge` (readout) with imports, templates and symbolic
work done, from flat ("cold") and from a press 0.5 mm away with a tenth more force ("warm"). Errors are of each charge,
relative to itself, over all four built-in sensors, against a solve of the same theory on a far finer mesh whose
electrodes are read with 60 x 60 points; so they contain mesh and readout, but not what a theory leaves out.
"""

import argparse
import json
import os
import platform
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from isocharge.simulate import (
    Circle,
    Equilibrium,
    Polygon,
    Probe,
    Resolution,
    Sensor,
    SolveSettings,
    Theory,
    built_in_sensors,
    load_sensor,
    press,
    touch_charge,
)
from isocharge.simulate.forward.readout import ReadoutPoints
from isocharge.simulate.mesh.template import template_for

SENSORS = tuple(load_sensor(name) for name in built_in_sensors())
FILM, PROBE = SENSORS[0].film, Circle(1e-3)
MEMBRANE, BENT = (Theory(stretching=True, bending=bending, pretensioned=False) for bending in (False, True))
REFINED = {MEMBRANE: Resolution(10, 8, 8), BENT: Resolution(9, 8, 8, 2)}
RESOLUTIONS = {
    MEMBRANE: [
        Resolution(*numbers)
        for numbers in (
            (3, 8, 4), (3, 8, 6), (4, 8, 4), (4, 8, 5), (4, 8, 6), (5, 8, 5), (5, 8, 6), (6, 8, 6), (7, 8, 6),
        )
    ],
    BENT: [
        Resolution(*numbers)
        for numbers in (
            (3, 8, 4, 1), (3, 8, 6, 1), (4, 8, 4, 1), (4, 8, 5, 1), (4, 8, 6, 1), (5, 8, 5, 1), (5, 8, 6, 1),
            (6, 8, 6, 1), (7, 8, 6, 2),
        )
    ],
}  # fmt: skip
OTHERS = (("dolfinx P2, bending", 13.0, 8e-4), ("CalculiX S3", 25.0, 3e-2))
"""Fixed meshes of 13,000 to 14,000 triangles on a machine of this kind: seconds, worst charge."""

PROBES = (Circle(1e-3), Polygon.triangle(4e-3, 0.5), Polygon.rectangle(4e-3, 2e-3, 0.5))


@dataclass(frozen=True)
class Scene:
    """A press."""

    x: float
    y: float
    force: float

    def solve(
        self,
        theory: Theory,
        resolution: Resolution | None = None,
        start: Equilibrium | None = None,
        probe: Probe = PROBE,
    ) -> Equilibrium:
        return press(
            FILM, probe, (self.x, self.y), self.force, SolveSettings(theory=theory, resolution=resolution), start=start
        )

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


def row(
    theory: Theory, resolution: Resolution, away: list[Scene], on: list[Scene], exact: dict[Scene, np.ndarray]
) -> dict[str, Any]:
    """One line of a table."""
    for scene in away[:2]:
        touch_charge(SENSORS[0], scene.solve(theory, resolution, start=scene.neighbour().solve(theory, resolution)))
    cold, warm, errors = [], [], {}
    for scene in away + on:
        spent, solved = milliseconds(lambda scene=scene: scene.solve(theory, resolution))
        reading, _ = milliseconds(lambda solved=solved: touch_charge(SENSORS[0], solved))
        cold.append(spent + reading)
        errors[scene] = np.abs(charges(solved) / exact[scene] - 1.0)
        start = scene.neighbour().solve(theory, resolution)
        spent, _ = milliseconds(lambda scene=scene, start=start: scene.solve(theory, resolution, start=start))
        warm.append(spent + reading)
    off_probe, on_probe = (np.concatenate([errors[scene] for scene in group]) for group in (away, on))
    return {
        "theory": theory.name,
        **asdict(resolution),
        "unknowns": 3 * template_for(PROBE, resolution).n_node,
        "cold_ms": [float(np.median(cold)), float(np.quantile(cold, 0.95))],
        "warm_ms": [float(np.median(warm)), float(np.quantile(warm, 0.95))],
        "error_median": float(np.median(off_probe)),
        "error_worst": float(off_probe.max()),
        "error_on_electrode_worst": float(on_probe.max()),
    }


def chosen(theory: Theory, probe: Probe, scenes: list[Scene]) -> dict[str, Any]:
    """The mesh that `press` takes by itself, for a probe."""
    spent, errors = [], []
    for scene in scenes:
        solved = scene.solve(theory, probe=probe)
        finer = Resolution(8, 16, 8, 2 if theory.bending else 0)
        exact = refined_charges(scene.solve(theory, finer, probe=probe))
        errors.append(np.abs(charges(solved) / exact - 1.0).max())
        spent.append(milliseconds(lambda scene=scene: scene.solve(theory, probe=probe))[0])
    return {
        "theory": theory.name,
        "probe": probe.notation,
        **asdict(solved.resolution),
        "cold_ms": float(np.median(spent)),
        "error_worst": float(np.max(errors)),
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
    rows = []
    for theory, resolutions in RESOLUTIONS.items():
        exact = {scene: refined_charges(scene.solve(theory, REFINED[theory])) for scene in away + on}
        rows += [row(theory, resolution, away, on, exact) for resolution in resolutions]
    return {
        "machine": machine(),
        "positions": positions,
        "seed": seed,
        "meshes": rows,
        "chosen": [chosen(theory, probe, away[:3] + on[:3]) for probe in PROBES for theory in (MEMBRANE, BENT)],
    }


def tables(result: dict[str, Any]) -> str:
    """The record for people."""
    lines = [
        ", ".join(f"{key} {value}" for key, value in result["machine"].items()),
        f"{result['positions']} + {result['positions']} presses (away from, on or beside an electrode), seed "
        f"{result['seed']}",
        "",
        "order, around, rings, rim | unknowns | cold ms (95 %) | warm ms (95 %) | error median, worst | on electrode",
    ]
    for entry in result["meshes"]:
        mesh = f"{entry['order']}, {entry['around']}, {entry['rings']}, {entry['rim']}"
        lines.append(
            f"{entry['theory']:28} {mesh:12} | {entry['unknowns']:6} | {entry['cold_ms'][0]:4.0f} "
            f"({entry['cold_ms'][1]:.0f}) | {entry['warm_ms'][0]:4.0f} ({entry['warm_ms'][1]:.0f}) | "
            f"{entry['error_median']:.1e}, {entry['error_worst']:.1e} | {entry['error_on_electrode_worst']:.1e}"
        )
    lines += ["", "as press chooses: cold ms, worst charge of six presses"]
    lines += [
        f"{e['probe']:18} {e['theory']:28} {e['order']}, {e['around']}, {e['rings']}, {e['rim']}  "
        f"{e['cold_ms']:.0f} ms  {e['error_worst']:.1e}"
        for e in result["chosen"]
    ]
    return "\n".join(lines)


def plot(result: dict[str, Any], path: Path) -> None:
    """Time against error, the other programs beside it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    axes = figure.subplots()
    for theory, colour in ((MEMBRANE, "#1f6f8b"), (BENT, "#c8553d")):
        mine = [entry for entry in result["meshes"] if entry["theory"] == theory.name]
        for key, marker, label in (
            ("error_worst", "o", "away from electrodes"),
            ("error_on_electrode_worst", "s", "on one"),
        ):
            axes.loglog(
                [entry["cold_ms"][0] * 1e-3 for entry in mine], [entry[key] for entry in mine], marker, color=colour,
                ms=5, mfc=colour if key == "error_worst" else "none", label=f"{theory.name}, probe {label}",
            )  # fmt: skip
        for entry in mine:
            axes.annotate(f"{entry['order']}", (entry["cold_ms"][0] * 1e-3, entry["error_worst"]), xytext=(4, 4),
                          textcoords="offset points", fontsize=7, color=colour)  # fmt: skip
    for name, seconds, error in OTHERS:
        axes.loglog(seconds, error, "k^", ms=6)
        axes.annotate(name, (seconds, error), xytext=(-6, 6), textcoords="offset points", ha="right", fontsize=8)
    axes.axhline(1e-3, color="0.6", lw=0.8, ls=":")
    axes.set(
        xlabel="process CPU time of one press from flat, s",
        ylabel="worst error of a charge",
        title="Speed against error (numbers: order of the elements)",
    )
    axes.grid(True, which="major", color="0.9")
    axes.legend(fontsize=7, loc="lower right")
    figure.savefig(path, dpi=130)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="CPU time of one press against the error of its charges.")
    parser.add_argument("--positions", type=int, default=20, help="presses of each kind (default: 20)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="one JSON object instead of tables")
    parser.add_argument("--plot", type=Path, help="write a picture")
    arguments = parser.parse_args()
    result = record(arguments.positions, arguments.seed)
    if arguments.plot:
        plot(result, arguments.plot)
    print(json.dumps(result) if arguments.json else tables(result))


if __name__ == "__main__":
    main()
