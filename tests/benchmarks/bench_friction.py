"""How well films are calibrated by presses with friction, and how often contacts with side forces are covered.

    python tests/benchmarks/bench_friction.py [--sensor four-25um-biaxial] [--films 4] [--seed 0] [--friction 0.2]
        [--side-force 0.1] [--json]

Each film is drawn from the prior, with a pretension of 0.5 to 1.5 MPa, and calibrated by 20 presses. The effect of side
forces is solved on the drawn film, and again by the calibration on the film that it finds. The benchmark gives
root-mean-square errors of 300 further contacts, and the shares of the positions and of the forces within two reported
standard deviations:

- friction not stated: presses with friction, calibrated as presses without;
- friction stated: the same presses, calibrated with the expected coefficient;
- side force not declared: presses without friction, and a model whose contacts are assumed to have no side force;
- side force declared: the same presses, and a model whose contacts may have a side force.

The benchmark also gives the CPU time of each calibration.
"""

import time
from dataclasses import replace

import numpy as np
from measured_films import contact_errors, measured_presses, with_rig_errors
from shared import arguments, print_results, report_progress

from isocharge.simulate import Circle, SideForceMap, load_sensor
from isocharge.train import CalibrationProblem, CalibrationResult, calibrate
from isocharge.train.data.presses import draw_contacts

PRESSES = 20
CONTACTS = 300
PRETENSION_MPa = (0.5, 1.5)


def errors(result: CalibrationResult, charge: np.ndarray, contact: np.ndarray) -> dict[str, float]:
    """Return the errors of a calibrated model, and the shares within two standard deviations; see `contact_errors`."""
    answer, std, _ = result.fitted_film(result.posterior.parameters).predict(charge)
    return contact_errors(answer, std, contact)


def calibrated_film(problem: CalibrationProblem, seed: list[int], friction: float, side_force: float) -> dict:
    """Calibrate one film in each way, and return the errors of each kind of contacts."""
    rng = np.random.default_rng(seed)
    parameters = problem.prior.draw(rng, 1)[0]
    parameters[problem.prior.index("pretension")] = rng.uniform(*PRETENSION_MPa)
    film = problem.charges.forward_map(parameters)
    side_force_map = SideForceMap.build(film)

    def noisy(contact: np.ndarray, side_charge: np.ndarray | float) -> np.ndarray:
        """Return the charges of contacts with the given charges by side forces."""
        return problem.noise.add(film.charges(contact) + side_charge, rng)

    pressed = draw_contacts(rng, problem.domain, PRESSES)
    read = with_rig_errors(pressed, rng)
    presses_with_friction = measured_presses(
        problem, read, noisy(pressed, side_force_map.friction_charges(pressed, friction))
    )
    presses_without = measured_presses(problem, read, noisy(pressed, 0.0))

    contact = draw_contacts(rng, problem.domain, CONTACTS)
    angle = rng.uniform(0.0, 2.0 * np.pi, CONTACTS)
    force = side_force * contact[:, 2, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    charge = {
        "without friction": noisy(contact, 0.0),
        "with friction": noisy(contact, side_force_map.friction_charges(contact, friction)),
        "with a side force": noisy(contact, np.einsum("nek,nk->ne", side_force_map.jacobian(contact), force)),
    }
    friction_kinds = ("without friction", "with friction")
    side_force_kinds = ("with a side force",)
    cases = {
        "friction not stated": (presses_with_friction, problem, friction_kinds),
        "friction stated": (presses_with_friction, replace(problem, friction=friction), friction_kinds),
        "side force not declared": (presses_without, problem, side_force_kinds),
        "side force declared": (presses_without, replace(problem, side_force=side_force), side_force_kinds),
    }
    table = {}
    for method, (presses, stated_problem, kinds) in cases.items():
        begin_s = time.process_time()
        result = calibrate(presses, stated_problem)
        table[f"{method}, calibration"] = {"cpu_s": time.process_time() - begin_s}
        for kind in kinds:
            table[f"{method}, contacts {kind}"] = errors(result, charge[kind], contact)
        if stated_problem.friction > 0.0:
            estimate = result.posterior.nuisances["friction"]
            table["estimated coefficient"] = {"value": estimate.value, "std": estimate.std}
    return table


def main() -> None:
    asked = arguments(__doc__, sensor="four-25um-biaxial", films=4, seed=0, friction=0.2, side_force=0.1, json=False)
    problem = CalibrationProblem.of(load_sensor(asked.sensor), Circle(1.0))
    seeds = [[asked.seed, number, 61] for number in range(asked.films)]
    films = []
    for seed in seeds:
        film = calibrated_film(problem, seed, asked.friction, asked.side_force)
        for title, values in film.items():
            report_progress(f"film {len(films)}, {title}", values)
        films.append(film)
    results = {
        title: {key: round(float(np.mean([film[title][key] for film in films])), 4) for key in films[0][title]}
        for title in films[0]
    }
    print_results("friction", asked, results)


if __name__ == "__main__":
    main()
