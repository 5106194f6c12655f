"""Errors of calibrated and followed films with imperfections, whose presses are solved one by one.

    python tests/benchmarks/bench_calibration.py [--sensor four-25um-biaxial] [--seeds 0,1,2,3] [--presses 8,20]
        [--changes 0,0.3,-0.4] [--frames 10] [--folder build/solved_films] [--json]

The films are those of `solved_films.py`: orthotropic, unevenly stretched, with an oval clamp and wrong gains. Each film
is calibrated by presses with errors of 0.1 mm and 1 %. The benchmark gives root-mean-square errors of 60 further
contacts and the shares of x, y and the force within two reported standard deviations:

- calibrated, N presses: the film has not changed;
- followed, change: after 60 touches of unknown place and force, each with ten frames, on the film whose pretension has
  changed by this amount (MPa). The film was calibrated by the largest number of presses.

Solved charges are stored in the folder. Solving a film takes one to three minutes for each change.
"""

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np
from measured_films import contact_errors, measured_presses, with_rig_errors
from shared import arguments, print_results, report_progress
from solved_films import solved_film

from isocharge.serve import Predictor
from isocharge.serve.tracking.film_follower import FilmFollower
from isocharge.simulate import Circle, load_sensor, local_workers
from isocharge.train import CalibrationProblem, calibrate, write_calibration

TOUCHES = 60
CONTACTS = 60
MAX_PRESSES = 20


def errors(answers: list, truth: np.ndarray) -> dict[str, float]:
    """Return the errors of contacts and the shares within two standard deviations."""
    contact = np.array([answer[:3] for answer in answers])
    std = np.array([[answer.x_std_mm, answer.y_std_mm, answer.force_std_N] for answer in answers])
    return contact_errors(contact, std, truth)


def followed(predictor: Predictor, touch_charge: np.ndarray, frames: int, noise, rng) -> FilmFollower:
    """Return a follower that has observed touches, each with several frames of noise."""
    follower = FilmFollower(predictor)
    clock_s = 0.0
    for row in touch_charge:
        for frame in noise.add(np.repeat(row[None], frames, axis=0), rng):
            follower.observe_frame(frame, predictor.predict(frame), (), clock_s)
            clock_s += 0.01
        follower.observe_frame(None, None, (), clock_s)
        clock_s += 1.0
    return follower


def main() -> None:
    asked = arguments(
        __doc__,
        sensor="four-25um-biaxial",
        seeds="0,1,2,3",
        presses="8,20",
        changes="0,0.3,-0.4",
        frames=10,
        folder=Path("build/solved_films"),
        json=False,
    )
    problem = CalibrationProblem(load_sensor(asked.sensor), Circle(1.0))
    changes = [float(change) for change in asked.changes.split(",")]
    results: dict[str, list[dict[str, float]]] = {}
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool, local_workers(2) as executor:
        for seed in (int(text) for text in asked.seeds.split(",")):
            counts = (MAX_PRESSES, TOUCHES + CONTACTS)
            films = {change: solved_film(problem, seed, change, counts, asked.folder, pool) for change in changes}
            first = films[changes[0]]
            rng = np.random.default_rng([seed, 51])
            contact = with_rig_errors(first.contact, rng)
            charge = problem.noise.add(first.charge, rng)
            with TemporaryDirectory() as folder:
                for count in (int(text) for text in asked.presses.split(",")):
                    start = perf_counter()
                    result = calibrate(
                        measured_presses(problem, contact[:count], charge[:count]), problem, executor=executor
                    )
                    version = write_calibration(result, Path(folder) / f"film-{count}", executor=executor)
                    predictor = Predictor(version)
                    values = {"time_s": perf_counter() - start}
                    if 0.0 in films:
                        truth = films[0.0].later_contact[TOUCHES:]
                        rows = problem.noise.add(films[0.0].later_charge[TOUCHES:], rng)
                        values |= errors([predictor.predict(row) for row in rows], truth)
                    report_progress(f"film {seed}, {count} presses", values)
                    results.setdefault(f"calibrated, {count} presses", []).append(values)
                for change, film in films.items():
                    follower = followed(predictor, film.later_charge[:TOUCHES], asked.frames, problem.noise, rng)
                    rows = problem.noise.add(film.later_charge[TOUCHES:], rng)
                    answers = [follower.follow_contact(predictor.predict(row), row).contact for row in rows]
                    values = errors(answers, film.later_contact[TOUCHES:])
                    report_progress(f"film {seed}, followed, {change:+g} MPa", values)
                    results.setdefault(f"followed, {change:+g} MPa", []).append(values)
    means = {
        name: {key: float(np.mean([value[key] for value in values])) for key in values[0]}
        for name, values in results.items()
    }
    print_results("calibration", asked, means)


if __name__ == "__main__":
    main()
