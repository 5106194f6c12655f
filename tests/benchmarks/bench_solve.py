"""CPU time and error of a solve for several meshes, without and with bending.

    python tests/benchmarks/bench_solve.py [--positions 20] [--seed 1] [--plot FILE.png]       (ten minutes)

The time is the CPU time of `press` (mesh and Newton's method) and `touch_charge` (readout). Imports, templates and the
symbolic factorisation are done before. A solve starts from the flat film ("cold"), or from a press 0.5 mm away with 1.1
times the force ("warm").

The errors are relative errors of each charge of the built-in sensors. The reference is a solve with the same theory on
a far finer mesh, whose electrodes are read at 60 x 60 points. The errors therefore contain those of mesh and readout,
but not the effects that a theory neglects.
"""

import time
from pathlib import Path
from typing import Any

import numpy as np
from shared import arguments, print_results

from isocharge.simulate import (
    Circle,
    Equilibrium,
    Resolution,
    SolveSettings,
    Theory,
    load_sensor,
    press,
    touch_charge,
)
from isocharge.simulate.forward.readout import stress_charge
from isocharge.simulate.mesh.template import template_for
from isocharge.simulate.plots.figure import new_figure

SENSORS = [load_sensor(f"{layout}-25um-{kind}") for layout in ("three", "four") for kind in ("biaxial", "uniaxial")]
FILM = SENSORS[0].film
PROBE = Circle(1.0)
MEMBRANE = Theory(bending=False)
WITH_BENDING = Theory(bending=True)
REFERENCE_MESHES = {MEMBRANE: Resolution(10, 8, 8), WITH_BENDING: Resolution(9, 8, 8, 3)}
"""Meshes of the reference solves."""

MESHES = {
    MEMBRANE: ((3, 8, 4), (4, 8, 4), (4, 8, 6), (5, 8, 6), (6, 8, 6), (7, 8, 6)),
    WITH_BENDING: ((3, 8, 4, 2), (4, 8, 6, 2), (5, 8, 6, 2), (6, 8, 6, 2), (7, 8, 6, 3)),
}
"""Meshes that are measured, as the arguments of `Resolution`. The first number is the order of the elements."""


def draw_contacts(count: int, seed: int, *, on_electrode: bool) -> np.ndarray:
    """Draw presses of 0.05 to 2 N.

    Args:
        count: Number of presses.
        seed: Seed of the presses.
        on_electrode: Whether the presses are within 2.5 mm of the centre of an electrode. Otherwise they are at least
            4 mm from all centres and within 10 mm of the centre of the film.

    Returns:
        Contacts (x, y, F), shape (count, 3), mm and N.
    """
    rng = np.random.default_rng([seed, on_electrode])
    centres = np.array([complex(*electrode.centre) for sensor in SENSORS for electrode in sensor.electrodes])
    candidate_count = 500 * count
    position = 12.0 * np.sqrt(rng.random(candidate_count)) * np.exp(2j * np.pi * rng.random(candidate_count))
    distance = np.abs(position[:, None] - centres).min(axis=1)
    is_near_electrode = distance < 2.5
    is_away = (distance > 4.0) & (np.abs(position) < 10.0)
    chosen = position[is_near_electrode if on_electrode else is_away][:count]
    force = np.exp(rng.uniform(np.log(0.05), np.log(2.0), count))
    return np.stack([chosen.real, chosen.imag, force], axis=1)


def solve(contact: np.ndarray, settings: SolveSettings, start: Equilibrium | None = None) -> tuple[Equilibrium, float]:
    """Solve a press, and return the equilibrium and the CPU time of solve and readout, ms."""
    x, y, force = contact.tolist()
    start_s = time.process_time()
    solved = press(FILM, PROBE, (x, y), force, settings, start=start)
    touch_charge(SENSORS[0], solved)
    return solved, 1e3 * (time.process_time() - start_s)


def reference_charges(theory: Theory, contacts: np.ndarray) -> np.ndarray:
    """Return the charges of all sensors on the finest mesh, shape (n, n_charge), pC, for contacts of shape (n, 3)."""
    settings = SolveSettings(theory=theory, resolution=REFERENCE_MESHES[theory])
    rows = []
    for contact in contacts:
        reference, _ = solve(contact, settings)
        rows.append(np.concatenate([stress_charge(sensor, reference, (60, 60)) for sensor in SENSORS]))
    return np.array(rows)


def measure_mesh(
    theory: Theory, mesh: tuple[int, ...], groups: dict[str, np.ndarray], references: dict[str, np.ndarray]
) -> dict[str, Any]:
    """Measure times and errors of a mesh.

    Args:
        theory: Theory of the film.
        mesh: Arguments of `Resolution`.
        groups: Presses, shape (n, 3) each, by the name of the group.
        references: Reference charges of these presses, shape (n, n_charge) each, by the name of the group.
    """
    settings = SolveSettings(theory=theory, resolution=Resolution(*mesh))
    cold_ms = []
    warm_ms = []
    errors: dict[str, list[float]] = {name: [] for name in groups}
    for name, contacts in groups.items():
        for contact, reference in zip(contacts, references[name], strict=True):
            neighbour_contact = contact * [1.0, 1.0, 1.1] + [0.3, -0.4, 0.0]
            neighbour, _ = solve(neighbour_contact, settings)
            solved, cold_time_ms = solve(contact, settings)
            _, warm_time_ms = solve(contact, settings, start=neighbour)
            cold_ms.append(cold_time_ms)
            warm_ms.append(warm_time_ms)
            charge = np.concatenate([touch_charge(sensor, solved) for sensor in SENSORS])
            errors[name] += np.abs(charge / reference - 1.0).tolist()
    return {
        "theory": theory.name,
        "mesh": mesh,
        "unknowns": 3 * template_for(settings.resolution, PROBE.topology).n_node,
        "cold_ms": np.quantile(cold_ms[1:], [0.5, 0.95]).tolist(),
        "warm_ms": np.quantile(warm_ms[1:], [0.5, 0.95]).tolist(),
        **{f"error_{name}": [float(np.median(values)), max(values)] for name, values in errors.items()},
    }


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Draw the largest error against the CPU time, with the order of the elements beside each point."""
    axes = new_figure(7.2, 4.4).subplots()
    for theory in MESHES:
        for group, where, marker in (("away", "away from electrodes", "o"), ("on", "on electrodes", "s")):
            points = [
                (row["cold_ms"][0], row[f"error_{group}"][1], row["mesh"][0])
                for row in rows
                if row["theory"] == theory.name
            ]
            times_ms, errors, _ = zip(*points, strict=True)
            axes.loglog(times_ms, errors, marker, ms=5, label=f"{theory.name}, {where}")
            for time_ms, error, order in points:
                axes.annotate(order, (time_ms, error), xytext=(4, 4), textcoords="offset points", fontsize=7)
    axes.set(xlabel="CPU time of one press, ms", ylabel="worst error of a charge", title="Numbers: order of elements")
    axes.grid(True, color="0.9")
    axes.legend(fontsize=7)
    axes.figure.savefig(path, dpi=130)


def main() -> None:
    asked = arguments(__doc__, positions=20, seed=1, plot=None)
    groups = {
        "away": draw_contacts(asked.positions, asked.seed, on_electrode=False),
        "on": draw_contacts(asked.positions, asked.seed, on_electrode=True),
    }
    rows = []
    for theory, meshes in MESHES.items():
        references = {name: reference_charges(theory, contacts) for name, contacts in groups.items()}
        rows += [measure_mesh(theory, mesh, groups, references) for mesh in meshes]
    if asked.plot:
        plot(rows, asked.plot)
    print_results("solve", asked, {"meshes": rows})


if __name__ == "__main__":
    main()
