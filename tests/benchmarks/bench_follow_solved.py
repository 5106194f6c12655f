"""How well films with imperfections are followed, whose presses are solved one by one.

    python tests/benchmarks/bench_follow_solved.py [--sensor four-25um-biaxial] [--seeds 0,1,2,3,4,6,7,8,9,10]
        [--change 0.3] [--frames 10] [--orders 4] [--workers 2] [--folder build/solved_films] [--json]

The films are those of `solved_films.py`: orthotropic, unevenly stretched, with an oval clamp and wrong gains. Each
film is calibrated by 20 presses. Its pretension then changes, and 60 touches of unknown place and force follow. The
force of a touch is constant for the given number of frames, each with its own noise. The benchmark gives
root-mean-square errors of 60 further contacts, each computed from one frame, and the shares of the positions and of the
forces within two reported standard deviations:

- calibrated: by the calibrated model;
- followed: by the model that `serve stream --follow` uses after the touches;
- calibrated again: by a second calibration from the average charges of the same touches, as `train calibrate --from`
  does;
- followed, other touches: as followed, for other random orders of the presses, so that other presses are the touches.

A change of -0.45 MPa is the change of a film that is 1 K warmer than its ring. Solved charges are stored in the folder.
Solving a film takes about three minutes. The results of each film are printed as soon as they are available. A film
whose calibration cannot be followed is named and left out.
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from bench_follow import answers, mean, noisy_frames, observe
from measured_films import contact_errors, measured_presses, with_rig_errors
from shared import arguments, print_results, report_progress
from solved_films import SolvedFilm, solved_film

from isocharge.common.errors import ModelError
from isocharge.serve import Contact, Predictor
from isocharge.serve.tracking.film_follower import FilmFollower
from isocharge.simulate import Circle, load_sensor
from isocharge.train import CalibrationProblem, calibrate, write_calibration

PRESSES = 20
TOUCHES = 60
CONTACTS = 60


def errors(answer: list[Contact], truth: np.ndarray) -> dict[str, float]:
    """Return the errors of contacts and the shares within two standard deviations; see `contact_errors`."""
    contact = np.array([one[:3] for one in answer])
    std = np.array([[one.x_std_mm, one.y_std_mm, one.force_std_N] for one in answer])
    return contact_errors(contact, std, truth)


def follow(predictor: Predictor, film: SolvedFilm, frames: np.ndarray, order: np.ndarray) -> dict[str, float]:
    """Follow a film through its first presses after the change, and return the errors for the other presses.

    Args:
        predictor: The calibrated model.
        film: The film.
        frames: Charges of the frames of the later presses with noise, shape (n, n_frame, n_electrode), pC.
        order: Order of the later presses, shape (n,). The first `TOUCHES` presses are the touches.
    """
    follower = FilmFollower(predictor)
    touches, others = np.split(order, [TOUCHES])
    observe(follower, frames[touches])
    return errors(answers(follower, frames[others, 0]), film.later_contact[others])


def followed_film(
    problem: CalibrationProblem, film: SolvedFilm, seed: int, frame_count: int, orders: int
) -> dict[str, dict[str, float]]:
    """Calibrate a film, let it change, and return the errors of each method."""
    rng = np.random.default_rng([seed, 51])
    contact = with_rig_errors(film.contact, rng)
    presses = measured_presses(problem, contact, problem.noise.add(film.charge, rng))
    later_frames = noisy_frames(problem, film.later_charge, frame_count, rng)
    touch_charge = later_frames[:TOUCHES].mean(axis=1)
    charge = later_frames[TOUCHES:, 0]
    truth = film.later_contact[TOUCHES:]

    calibration = calibrate(presses, problem)
    earlier = calibration.posterior.drifted(problem.prior)
    unknown_contacts = np.full((TOUCHES, 3), np.nan)
    again = calibrate(measured_presses(problem, unknown_contacts, touch_charge), replace(problem, earlier=earlier))
    with TemporaryDirectory() as folder:
        calibrated_folder = Path(folder) / "calibrated"
        again_folder = Path(folder) / "again"
        write_calibration(calibration, calibrated_folder)
        write_calibration(again, again_folder)
        predictor = Predictor(calibrated_folder)
        again_predictor = Predictor(again_folder)
        given_order = np.arange(len(later_frames))
        followed = follow(predictor, film, later_frames, given_order)
        random_orders = [rng.permutation(given_order) for _ in range(orders)]
        other_touches = [follow(predictor, film, later_frames, order) for order in random_orders]
        return {
            "calibrated": errors([predictor.predict(row) for row in charge], truth),
            "followed": followed,
            "calibrated again": errors([again_predictor.predict(row) for row in charge], truth),
            "followed, other touches": mean(other_touches),
        }


def main() -> None:
    asked = arguments(
        __doc__,
        sensor="four-25um-biaxial",
        seeds="0,1,2,3,4,6,7,8,9,10",
        change=0.3,
        frames=10,
        orders=4,
        workers=2,
        folder=Path("build/solved_films"),
        json=False,
    )
    problem = CalibrationProblem.of(load_sensor(asked.sensor), Circle(1.0))
    counts = (PRESSES, TOUCHES + CONTACTS)
    films = []
    with ProcessPoolExecutor(asked.workers, mp_context=get_context("spawn")) as pool:
        for seed in asked.seeds.split(","):
            solved = solved_film(problem, int(seed), asked.change, counts, asked.folder, pool)
            try:
                film = followed_film(problem, solved, int(seed), asked.frames, asked.orders)
            except ModelError as error:  # the calibration has written no file for following
                print(f"film {seed}: cannot be followed ({error})", file=sys.stderr)
                continue
            for method, values in film.items():
                report_progress(f"film {seed}, {method}", values)
            films.append(film)
    methods = films[0] if films else ()
    results = {method: mean([film[method] for film in films]) for method in methods}
    print_results("follow_solved", asked, results)


if __name__ == "__main__":
    main()
