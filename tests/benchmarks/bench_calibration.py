"""Errors of calibrated, faulty and changed films with imperfections, whose presses are solved one by one.

    python tests/benchmarks/bench_calibration.py [--films typical] [--seeds 0,1,2,3] [--presses 1,5,8,20]
        [--changes 0,0.3,-0.4] [--cases all] [--gain-noise 0.002] [--json]

The films are those of `solved_films.py`: orthotropic, unevenly stretched, with an oval clamp and wrong gains. With
`--films moduli`, E1 / E2 is 1.6; with `--films tension`, the ratio of the pretensions along two axes is 3. The presses
have errors of 0.1 mm and 1 %. All contacts are computed by the network of the model that `train calibrate` writes, from
one frame with noise. The benchmark gives root-mean-square errors of 60 contacts, the share of the forces within two
reported standard deviations, and the shares within the reported 95 % ellipse (x, y) and ellipsoid:

- N presses: the film has not changed.
- offset: all 20 presses and all later contacts have an offset of 10 pC.
- hysteresis: the 20 measured forces are 1 % too large or too small at random.
- again, change: a second calibration (`--from`) with 60 touches of unknown place and force, on the film whose
  pretension has changed by this amount (MPa), with the average charges of ten frames.
- followed, change: after the same touches, frame by frame, by the follower of `serve stream --follow`.
- followed suddenly, change: after 60 touches on the unchanged film and the first 20 touches after the change.
- followed, gain: the film has not changed, and one electrode has a gain that is 3 % larger.
- not followed: the same contacts by the calibrated model.

The errors of followed contacts are means over four draws of the noise.

`--gain-noise` is the true noise relative to the charge, which the calibration does not know. Solved charges are stored
in build/solved_films. Solving a film takes some minutes. `--cases calibrated` leaves all rows out but the first.
"""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp

import numpy as np
from measured_films import measured_presses, with_rig_errors
from scipy.special import chdtri
from shared import arguments, print_results, report_progress, whitened_errors
from solved_films import FILMS, SolvedFilm, solved_film

from isocharge.serve import Contact, Frame, Predictor
from isocharge.serve.signal_chain.stage import Setup
from isocharge.serve.tracking.film_follower import FilmFollower
from isocharge.simulate import Circle, NoiseModel, load_sensor, local_workers
from isocharge.train import CalibrationProblem, calibrate, write_calibration
from isocharge.train.data.contact_errors import position_error, rms

FOLDER = Path("build/solved_films")
"""Folder in which the charges of solved films are stored."""

FRAMES = 10
"""Number of frames of a touch."""

TOUCHES = 60
SUDDEN_TOUCHES = 20
DRAWS = 4
CONTACTS = 60
PRESSES = 20
OFFSET_pC = 10.0
HYSTERESIS = 0.01
GAINS = np.array([1.03, 1.0, 1.0, 1.0])


def errors(answers: list[Contact], truth: np.ndarray) -> dict[str, float]:
    """Return the errors of contacts and the shares within the reported regions."""
    contact, std, _, correlation = np.split(np.array(answers), [3, 6, 7], axis=1)
    squared_error = whitened_errors(contact, truth, std, correlation) ** 2
    return {
        "position_mm": rms(position_error(contact, truth)),
        "force_percent": 100.0 * rms(contact[:, 2] / truth[:, 2] - 1.0),
        "force_coverage": float(np.mean(np.abs(contact - truth)[:, 2] < 2.0 * std[:, 2])),
        "ellipse_95": float(np.mean(squared_error[:, :2].sum(axis=1) < chdtri(2, 0.05))),
        "ellipsoid_95": float(np.mean(squared_error.sum(axis=1) < chdtri(3, 0.05))),
    }


class Bench:
    """One film, from its presses to the errors of its models."""

    def __init__(
        self,
        problem: CalibrationProblem,
        noise: NoiseModel,
        films: dict[float, SolvedFilm],
        seed: int,
        executor,
        folder: str,
    ) -> None:
        """Measure the presses of a film.

        Args:
            problem: The calibration problem.
            noise: True noise of the charges, which the calibration does not know.
            films: The film after each change of its pretension.
            seed: Seed of the errors of the presses and of the noise.
            executor: Executor that runs the solves of the calibrations.
            folder: Folder in which the models are written.
        """
        self.problem = problem
        self.noise = noise
        self.films = films
        self.executor = executor
        self.folder = folder
        self.rng = np.random.default_rng([seed, 51])
        first = next(iter(films.values()))
        self.contact = with_rig_errors(first.contact, self.rng)
        self.charge = noise.add(first.charge, self.rng)

    def calibrated(self, contact: np.ndarray, charge: np.ndarray, problem: CalibrationProblem | None = None):
        """Calibrate a film by presses, and return the result and its model."""
        problem = problem or self.problem
        result = calibrate(measured_presses(problem, contact, charge), problem, executor=self.executor)
        folder = Path(mkdtemp(dir=self.folder)) / "film"
        return result, Predictor(write_calibration(result, folder, executor=self.executor))

    def later(self, change: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the later contacts on the film after a change, and their charges with noise."""
        film = self.films[change]
        return film.later_contact[TOUCHES:], self.noise.add(film.later_charge[TOUCHES:], self.rng)

    def touches(self, change: float) -> np.ndarray:
        """Return the charges of the frames of each touch, with noise, shape (n_touch, n_frame, n_electrode)."""
        charge = self.films[change].later_charge[:TOUCHES]
        return self.noise.add(np.repeat(charge[:, None], FRAMES, axis=1), self.rng)


def follower_after(predictor: Predictor, touches: np.ndarray) -> FilmFollower:
    """Return a follower that has observed touches frame by frame, 100 frames per second, a second between touches."""
    follower = FilmFollower(Setup(predictor.metadata.electrodes, predictor=predictor))
    clock_s = 0.0
    for charges in touches:
        for charge_pC in charges:
            # Every frame counts, whatever its flags, because the figures apply to touches all over the film.
            follower._peak.add_frame(predictor.predict(charge_pC), charge_pC)
            clock_s += 0.01
        follower.step(Frame(None, None, (), clock_s=clock_s))
        clock_s += 1.0
    return follower


def followed_errors(
    bench: Bench, predictor: Predictor, change: float, gains: np.ndarray
) -> dict[str, dict[str, float]]:
    """Return the errors of contacts after a change, for one draw of the noise of touches and contacts."""
    touches = gains * bench.touches(change)
    truth, charge = bench.later(change)
    charge = gains * charge

    def errors_after(touches: np.ndarray) -> dict[str, float]:
        follower = follower_after(predictor, touches)
        return errors([follower.follow_contact(predictor.predict(row), row) for row in charge], truth)

    ways = {
        "not followed": errors([predictor.predict(row) for row in charge], truth),
        "followed": errors_after(touches),
    }
    if change != 0.0:
        before = bench.touches(0.0)
        ways["followed suddenly"] = errors_after(np.concatenate([before, touches[:SUDDEN_TOUCHES]]))
    return ways


def mean_values(rows: list[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each value."""
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def film_results(bench: Bench, counts: list[int], *, has_all_cases: bool) -> dict[str, dict[str, float]]:
    """Return the errors of all cases of one film."""
    results = {}
    truth, charge = bench.later(0.0)
    for count in counts:
        result, predictor = bench.calibrated(bench.contact[:count], bench.charge[:count])
        answers = [predictor.predict(row) for row in charge]
        results[f"{count} presses"] = errors(answers, truth)
    if not has_all_cases:
        return results

    _, offset_predictor = bench.calibrated(bench.contact, bench.charge + OFFSET_pC)
    results["offset"] = errors([offset_predictor.predict(row) for row in charge + OFFSET_pC], truth)
    contact = bench.contact.copy()
    contact[:, 2] *= 1.0 + HYSTERESIS * np.sign(bench.rng.standard_normal(len(contact)))
    _, hysteresis_predictor = bench.calibrated(contact, bench.charge)
    results["hysteresis"] = errors([hysteresis_predictor.predict(row) for row in charge], truth)

    cases = [(f"{change:+g} MPa", change, np.ones(len(GAINS))) for change in bench.films]
    for name, change, gains in (*cases, ("gain", 0.0, GAINS)):
        draws = [followed_errors(bench, predictor, change, gains) for _ in range(DRAWS)]
        for way in draws[0]:
            results[f"{way}, {name}"] = mean_values([draw[way] for draw in draws])
        if change != 0.0:
            problem = replace(bench.problem, earlier=result.film.drifted())
            mean_charge = bench.touches(change).mean(axis=1)
            _, again = bench.calibrated(np.full((TOUCHES, 3), np.nan), mean_charge, problem)
            truth, charge = bench.later(change)
            results[f"again, {name}"] = errors([again.predict(row) for row in charge], truth)
    for name, values in results.items():
        report_progress(name, values)
    return results


def main() -> None:
    asked = arguments(
        __doc__,
        films="typical",
        seeds="0,1,2,3",
        presses="1,5,8,20",
        changes="0,0.3,-0.4",
        cases="all",
        gain_noise=0.002,
    )
    problem = CalibrationProblem(load_sensor("four-25um-biaxial"), Circle(1.0))
    noise = NoiseModel("bench", problem.noise.white, asked.gain_noise)
    changes = [float(change) for change in asked.changes.split(",")]
    counts = [int(count) for count in asked.presses.split(",")]
    counts_of_solves = (PRESSES, TOUCHES + CONTACTS)
    all_results = []
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool, local_workers(2) as executor:
        for seed in (int(text) for text in asked.seeds.split(",")):
            films = {
                change: solved_film(
                    problem, FILMS[asked.films], seed, change, counts_of_solves, FOLDER / asked.films, pool
                )
                for change in changes
            }
            report_progress("film", {"seed": float(seed)})
            with TemporaryDirectory() as folder:
                bench = Bench(problem, noise, films, seed, executor, folder)
                all_results.append(film_results(bench, counts, has_all_cases=asked.cases == "all"))
    summary = {}
    for name in all_results[0]:
        rows = [results[name] for results in all_results]
        summary[name] = mean_values(rows)
        for key in ("position_mm", "force_percent"):
            values = [row[key] for row in rows]
            summary[name] |= {f"{key}_min": min(values), f"{key}_max": max(values)}
    print_results("calibration", asked, summary)


if __name__ == "__main__":
    main()
