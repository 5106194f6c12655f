"""How well films with imperfections are followed, whose presses are solved one by one.

    python tests/benchmarks/bench_follow_solved.py [--sensor four-25um-biaxial] [--seeds 0,1,3,4] [--change 0.3]
        [--workers 2] [--folder build/solved_films] [--json]

The films are those of `solved_films.py`: orthotropic, unevenly stretched, with an oval clamp and wrong gains. Every
third film has ink on its electrodes. Each film is calibrated by 20 presses. Its pretension then changes, and 60 touches
of unknown place and force follow. The benchmark gives root-mean-square errors of 60 further contacts, and the shares of
the positions and of the forces within two reported standard deviations:

- calibrated: by the calibrated model;
- followed: by the model that `serve stream --follow` uses after the touches;
- calibrated again: by a second calibration from the same touches, as `train calibrate --from` does.

Solved charges are stored in the folder. Solving a film takes about three minutes.
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from bench_follow import answers, mean, observe
from shared import arguments, print_results
from solved_films import SolvedFilm, solved_film

from isocharge.common.contact_errors import position_error
from isocharge.common.statistics import rms
from isocharge.serve import Contact, MeasuredPresses, Predictor
from isocharge.serve.tracking.film_follower import FilmFollower
from isocharge.simulate import Circle, load_sensor
from isocharge.train import CalibrationProblem, calibrate, write_calibration

PRESSES = 20
TOUCHES = 60
CONTACTS = 60

METHODS = ("calibrated", "followed", "calibrated again")

POSITION_STD_mm = 0.1
FORCE_STD = 0.01
"""Errors of the places and forces of the calibration's presses."""


def measured(problem: CalibrationProblem, contact: np.ndarray, charge: np.ndarray) -> MeasuredPresses:
    """Return presses with the stated errors of places and forces. Places and forces may be NaN."""
    count = len(contact)
    position_std_mm = np.full(count, POSITION_STD_mm)
    force_std = np.full(count, FORCE_STD)
    lines = tuple(range(2, count + 2))
    return MeasuredPresses(contact, charge, position_std_mm, force_std, problem.electrodes, lines)


def errors(answer: list[Contact], truth: np.ndarray) -> dict[str, float]:
    """Return the errors of contacts and the shares within two standard deviations."""
    contact = np.array([one[:3] for one in answer])
    std = np.array([[one.x_std_mm, one.y_std_mm, one.force_std_N] for one in answer])
    is_within = np.abs(contact - truth) < 2.0 * std
    return {
        "position_mm": rms(position_error(contact, truth)),
        "force_percent": 100.0 * rms(contact[:, 2] / truth[:, 2] - 1.0),
        "position_coverage": float(is_within[:, :2].mean()),
        "force_coverage": float(is_within[:, 2].mean()),
    }


def followed_film(problem: CalibrationProblem, film: SolvedFilm, seed: int) -> dict[str, dict[str, float]]:
    """Calibrate a film, let it change, and return the errors of each method."""
    rng = np.random.default_rng([seed, 51])
    contact = film.contact.copy()
    contact[:, :2] += POSITION_STD_mm * rng.standard_normal((len(contact), 2))
    contact[:, 2] *= np.exp(FORCE_STD * rng.standard_normal(len(contact)))
    presses = measured(problem, contact, problem.noise.add(film.charge, rng))
    later_charge = problem.noise.add(film.later_charge, rng)
    touch_charge, charge = np.split(later_charge, [TOUCHES])
    truth = film.later_contact[TOUCHES:]

    calibration = calibrate(presses, problem)
    earlier = calibration.posterior.drifted(problem.prior)
    unknown_contacts = np.full((TOUCHES, 3), np.nan)
    again = calibrate(measured(problem, unknown_contacts, touch_charge), replace(problem, earlier=earlier))
    with TemporaryDirectory() as folder:
        calibrated_folder = Path(folder) / "calibrated"
        again_folder = Path(folder) / "again"
        write_calibration(calibration, calibrated_folder)
        write_calibration(again, again_folder)
        predictor = Predictor(calibrated_folder)
        again_predictor = Predictor(again_folder)
        follower = FilmFollower(predictor)
        observe(follower, touch_charge)
        answer = {
            "calibrated": [predictor.predict(row) for row in charge],
            "followed": answers(follower, charge),
            "calibrated again": [again_predictor.predict(row) for row in charge],
        }
    return {method: errors(answer[method], truth) for method in METHODS}


def main() -> None:
    asked = arguments(
        __doc__,
        sensor="four-25um-biaxial",
        seeds="0,1,3,4",
        change=0.3,
        workers=2,
        folder=Path("build/solved_films"),
        json=False,
    )
    problem = CalibrationProblem.of(load_sensor(asked.sensor), Circle(1.0))
    seeds = [int(seed) for seed in asked.seeds.split(",")]
    counts = (PRESSES, TOUCHES + CONTACTS)
    with ProcessPoolExecutor(asked.workers, mp_context=get_context("spawn")) as pool:
        films = {seed: solved_film(problem, seed, asked.change, counts, asked.folder, pool) for seed in seeds}
    rows = {seed: followed_film(problem, film, seed) for seed, film in films.items()}
    results = {f"film {seed}, {method}": row[method] for seed, row in rows.items() for method in row}
    results |= {
        f"mean, {method}": mean([row[method] for row in rows.values()]) for method in list(next(iter(rows.values())))
    }
    print_results("follow_solved", asked, results)


if __name__ == "__main__":
    main()
