"""One press: CPU time against error, for several meshes, without and with bending.

    python tests/benchmarks/bench_solve.py [--positions 20] [--seed 1] [--plot FILE.png] [--json]       (ten minutes)

Time is the process CPU time of `press` (mesh, Newton) and `touch_charge` (readout) with imports, templates and symbolic
work done, from flat ("cold") and from a press 0.5 mm away with a tenth more force ("warm"). Errors are of each charge,
relative to itself, over the built-in sensors, against a solve of the same theory on a far finer mesh whose electrodes
are read with 60 x 60 points; so they contain mesh and readout, but not what a theory leaves out.
"""

import time
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from shared import arguments, print_results

from isocharge.simulate import (
    Circle,
    Equilibrium,
    Polygon,
    Resolution,
    SolveSettings,
    Theory,
    load_sensor,
    press,
    touch_charge,
    touch_stress,
)
from isocharge.simulate.forward.readout import ReadoutPoints
from isocharge.simulate.mesh.template import template_for

SENSORS = [load_sensor(f"{layout}-25um-{kind}") for layout in ("three", "four") for kind in ("biaxial", "uniaxial")]
FILM, PROBE = SENSORS[0].film, Circle(1.0)
MEMBRANE, BENT = (Theory(stretching=True, bending=bending, pretensioned=False) for bending in (False, True))
REFINED = {MEMBRANE: Resolution(10, 8, 8), BENT: Resolution(9, 8, 8, 2)}
MESHES = {
    MEMBRANE: ((3, 8, 4), (4, 8, 4), (4, 8, 6), (5, 8, 6), (6, 8, 6), (7, 8, 6)),
    BENT: ((3, 8, 4, 1), (4, 8, 6, 1), (5, 8, 6, 1), (6, 8, 6, 1), (7, 8, 6, 2)),
}
PROBES = (PROBE, Polygon.triangle(4.0, 0.5), Polygon.rectangle(4.0, 2.0, 0.5))


def contacts(count: int, seed: int, *, on_electrode: bool) -> np.ndarray:
    """Presses (x, y, F), mm and N: within 10 mm and 4 mm from all electrodes, or on or beside one; 0.05 to 2 N."""
    rng = np.random.default_rng([seed, on_electrode])
    centres = np.array([complex(*electrode.centre) for sensor in SENSORS for electrode in sensor.electrodes])
    z = 12.0 * np.sqrt(rng.random(500 * count)) * np.exp(2j * np.pi * rng.random(500 * count))
    nearest = np.abs(z[:, None] - centres).min(axis=1)
    z = z[nearest < 2.5 if on_electrode else (nearest > 4.0) & (np.abs(z) < 10.0)][:count]
    return np.stack([z.real, z.imag, np.exp(rng.uniform(np.log(0.05), np.log(2.0), count))], axis=1)


def timed(contact: np.ndarray, settings: SolveSettings, probe=PROBE, start=None) -> tuple[float, Equilibrium]:
    """CPU time of solve and readout, ms, and the equilibrium."""
    (x, y, force), began = contact.tolist(), time.process_time()
    solved = press(FILM, probe, (x, y), force, settings, start=start)
    touch_charge(SENSORS[0], solved)
    return 1e3 * (time.process_time() - began), solved


def worst_error(solved: Equilibrium, exact: Equilibrium) -> list[float]:
    """Relative errors of all charges of all sensors."""
    errors = []
    for sensor in SENSORS:
        rule = ReadoutPoints.of(sensor, 60)
        stress = touch_stress(exact, rule.points.reshape(-1, 2)).reshape(*rule.points.shape[:2], 3)
        errors += np.abs(touch_charge(sensor, solved) / rule.charge(stress) - 1.0).tolist()
    return errors


def measure(theory: Theory, mesh: tuple[int, ...], groups: dict[str, np.ndarray], exact: dict) -> dict:
    """One line of the table."""
    settings = SolveSettings(theory=theory, resolution=Resolution(*mesh))
    cold, warm, errors = [], [], {name: [] for name in groups}
    for name, group in groups.items():
        for number, contact in enumerate(group):
            neighbour = timed(contact * [1.0, 1.0, 1.1] + [0.3, -0.4, 0.0], settings)[1]
            spent, solved = timed(contact, settings)
            cold.append(spent)
            warm.append(timed(contact, settings, start=neighbour)[0])
            errors[name] += worst_error(solved, exact[theory, name, number])
    return {
        "theory": theory.name,
        "mesh": mesh,
        "unknowns": 3 * template_for(PROBE, settings.resolution).n_node,
        "cold_ms": np.quantile(cold[1:], [0.5, 0.95]).tolist(),
        "warm_ms": np.quantile(warm[1:], [0.5, 0.95]).tolist(),
        **{f"error_{name}": [float(np.median(values)), max(values)] for name, values in errors.items()},
    }


def chosen(theory: Theory, probe, group: np.ndarray) -> dict:
    """The mesh that `press` takes by itself, for a probe."""
    spent, errors = [], []
    for contact in group:
        _, solved = timed(contact, SolveSettings(theory=theory), probe)
        finer = replace(solved.mesh.resolution, order=solved.mesh.resolution.order + 3)
        errors += worst_error(solved, timed(contact, SolveSettings(theory=theory, resolution=finer), probe)[1])
        spent.append(timed(contact, SolveSettings(theory=theory), probe)[0])
    mesh = list(asdict(solved.mesh.resolution).values())
    return {
        "theory": theory.name, "probe": probe.notation, "mesh": mesh,
        "cold_ms": float(np.median(spent)), "error_worst": max(errors),
    }  # fmt: skip


def record(positions: int, seed: int) -> dict:
    """Everything that is measured."""
    groups = {"away": contacts(positions, seed, on_electrode=False), "on": contacts(positions, seed, on_electrode=True)}
    exact = {
        (theory, name, number): timed(contact, SolveSettings(theory=theory, resolution=resolution))[1]
        for theory, resolution in REFINED.items()
        for name, group in groups.items()
        for number, contact in enumerate(group)
    }
    return {
        "meshes": [measure(theory, mesh, groups, exact) for theory, meshes in MESHES.items() for mesh in meshes],
        "chosen": [chosen(theory, probe, groups["away"][:3]) for probe in PROBES for theory in MESHES],
    }


def plot(result: dict, path: Path) -> None:
    """Time against error."""
    figure = Figure(figsize=(7.2, 4.4), layout="constrained")
    axes = figure.subplots()
    for theory in MESHES:
        rows = [row for row in result["meshes"] if row["theory"] == theory.name]
        for place, marker in (("away", "o"), ("on", "s")):
            seconds, errors = [1e-3 * row["cold_ms"][0] for row in rows], [row[f"error_{place}"][1] for row in rows]
            axes.loglog(seconds, errors, marker, ms=5, label=f"{theory.name}, probe {place} electrodes")
            for row, *at in zip(rows, seconds, errors, strict=True):
                axes.annotate(row["mesh"][0], at, xytext=(4, 4), textcoords="offset points", fontsize=7)
    axes.set(xlabel="CPU time of one press, s", ylabel="worst error of a charge", title="Numbers: order of elements")
    axes.grid(True, color="0.9")
    axes.legend(fontsize=7)
    figure.savefig(path, dpi=130)


def main() -> None:
    asked = arguments(__doc__, positions=20, seed=1, plot=None, json=False)
    result = record(asked.positions, asked.seed)
    if asked.plot:
        plot(result, asked.plot)
    print_results("solve", asked, result)


if __name__ == "__main__":
    main()
