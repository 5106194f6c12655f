"""How well films are calibrated by presses with friction, and how often contacts with side forces are covered.

    python tests/benchmarks/bench_friction.py [--sensor four-25um-biaxial] [--films 3] [--seed 0] [--friction 0.2]
        [--side-force 0.1] [--json]

Each film is drawn from the prior distribution, with a pretension of 0.5 to 1.5 MPa, and calibrated by 20 presses. The
effect of side forces is solved on the drawn film, and again by the calibration on the film that it finds. The benchmark
gives root-mean-square errors of 300 further contacts, computed by the network of the model, and the shares of the
positions and of the forces within two reported standard deviations:

- friction not stated: presses with friction, calibrated as presses without;
- friction stated: the same presses, calibrated with the expected coefficient;
- side force not declared: presses without friction, and a model whose contacts are assumed to have no side force;
- side force declared: the same presses, and a model whose contacts may have a side force.
"""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from measured_films import contact_errors, measured_presses, with_rig_errors
from shared import arguments, print_results, report_progress

from isocharge.serve import MeasuredPresses, Predictor
from isocharge.simulate import Circle, ForwardMap, SideForceMap, load_sensor, local_workers
from isocharge.train import CalibrationProblem, calibrate, write_calibration
from isocharge.train.data.presses import draw_contacts

PRESSES = 20
CONTACTS = 300
PRETENSION_MPa = (0.5, 1.5)


def model_of(presses: MeasuredPresses, problem: CalibrationProblem, executor) -> Predictor:
    """Calibrate a film, and return its model."""
    result = calibrate(presses, problem, executor=executor)
    with TemporaryDirectory() as folder:
        return Predictor(write_calibration(result, Path(folder) / "film", executor=executor))


def errors(predictor: Predictor, charge: np.ndarray, contact: np.ndarray) -> dict[str, float]:
    """Return the errors of a model, and the shares within two standard deviations; see `contact_errors`."""
    answers = [predictor.predict(row) for row in charge]
    std = np.array([[answer.x_std_mm, answer.y_std_mm, answer.force_std_N] for answer in answers])
    return contact_errors(np.array([answer[:3] for answer in answers]), std, contact)


def film_results(problem: CalibrationProblem, seed: list[int], friction: float, share: float, executor) -> dict:
    """Calibrate one film in each way, and return the errors of each kind of contacts."""
    rng = np.random.default_rng(seed)
    prior = problem.prior.layout.prior
    values = prior.draw(rng, 1)[0]
    values[prior.index("pretension")] = rng.uniform(*PRETENSION_MPa)
    film = ForwardMap.build(*prior.film(values), executor=executor)
    side_force_map = SideForceMap.build(film, executor=executor)

    pressed = draw_contacts(rng, problem.domain, PRESSES)
    read = with_rig_errors(pressed, rng)
    friction_charge = side_force_map.friction_charges(pressed, friction)
    with_friction = measured_presses(problem, read, problem.noise.add(film.charges(pressed) + friction_charge, rng))
    without_friction = measured_presses(problem, read, problem.noise.add(film.charges(pressed), rng))

    contact = draw_contacts(rng, problem.domain, CONTACTS)
    free = problem.noise.add(film.charges(contact), rng)
    rubbing = problem.noise.add(film.charges(contact) + side_force_map.friction_charges(contact, friction), rng)
    angle = 2.0 * np.pi * rng.random(CONTACTS)
    side_force = share * contact[:, 2:] * np.column_stack([np.cos(angle), np.sin(angle)])
    side_charge = np.einsum("nek,nk->ne", side_force_map.jacobian(contact), side_force)
    pushed = problem.noise.add(film.charges(contact) + side_charge, rng)

    results = {}
    for name, stated in (("friction not stated", 0.0), ("friction stated", friction)):
        predictor = model_of(with_friction, replace(problem, friction=stated), executor)
        results[f"{name}, contacts without friction"] = errors(predictor, free, contact)
        results[f"{name}, contacts with friction"] = errors(predictor, rubbing, contact)
    for name, declared in (("side force not declared", 0.0), ("side force declared", share)):
        predictor = model_of(without_friction, replace(problem, side_force=declared), executor)
        results[name] = errors(predictor, pushed, contact)
    for name, values in results.items():
        report_progress(name, values)
    return results


def main() -> None:
    asked = arguments(__doc__, sensor="four-25um-biaxial", films=3, seed=0, friction=0.2, side_force=0.1, json=False)
    problem = CalibrationProblem(load_sensor(asked.sensor), Circle(1.0))
    with local_workers(2) as executor:
        films = [
            film_results(problem, [asked.seed, film], asked.friction, asked.side_force, executor)
            for film in range(asked.films)
        ]
    summary = {name: {key: [film[name][key] for film in films] for key in films[0][name]} for name in films[0]}
    print_results("friction", asked, summary)


if __name__ == "__main__":
    main()
