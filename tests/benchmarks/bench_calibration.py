"""Errors of calibrated, faulty and changed films with imperfections, whose presses are solved one by one.

    python tests/benchmarks/bench_calibration.py [--films typical] [--seeds 0,1,2,3] [--presses 1,5,8,20]
        [--changes 0,0.3,-0.4] [--cases all] [--gain-noise 0.002] [--sensor four-25um-biaxial] [--radius 9]

The films are those of `solved_films.py`: orthotropic, unevenly stretched, with an oval clamp and wrong gains. With
`--films moduli`, E1 / E2 is 1.6; with `--films tension`, the ratio of the pretensions along two axes is 3. The presses
have errors of 0.1 mm and 1 %. All contacts are computed by the network of the model that `train calibrate` writes, from
one frame with noise. The benchmark gives root-mean-square errors of 60 contacts, the share of the forces within two
reported standard deviations, and the shares within the reported 95 % ellipse (x, y) and ellipsoid. For a film that has
not changed, `rejected` is the share of the checks (`serve check`) that reject the model. A check uses 24 presses with
errors of 0.03 mm and 0.3 %.

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
in the folder build. Solving a film takes some minutes. `--cases calibrated` leaves all rows out but the first.
"""

from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp

import numpy as np
from measured_films import measured_presses, with_rig_errors
from scipy.special import chdtri
from shared import arguments, print_results, report_progress, whitened_errors
from solved_films import FILMS, Unevenness, draw_film, solve_charges

from isocharge.common.defaults import DEFAULT_RADIUS
from isocharge.serve import Contact, Frame, Predictor, check_presses
from isocharge.serve.signal_chain.stage import Setup
from isocharge.serve.tracking.film_follower import FilmFollower
from isocharge.simulate import Circle, NoiseModel, load_sensor, local_workers
from isocharge.train import CalibrationProblem, calibrate, write_calibration
from isocharge.train.data.contact_errors import position_error, rms
from isocharge.train.data.presses import draw_contacts

FRAMES = 10
"""Number of frames of a touch."""

TOUCHES = 60
SUDDEN_TOUCHES = 20
DRAWS = 4
CONTACTS = 60
PRESSES = 20
CHECKS = 100
CHECKED_PRESSES = 24
CHECK_SCALE = 0.3
"""Errors of the rig of a check, relative to those of a calibration."""

OFFSET_pC = 10.0
HYSTERESIS = 0.01
LARGEST_FORCE_N = 1.6
"""Largest force of a press and of a touch."""

LARGER_GAIN = 1.03
"""Gain of the first electrode in the case "gain"."""


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


def model_errors(predictor: Predictor, truth: np.ndarray, charge: np.ndarray) -> dict[str, float]:
    """Return the errors of the contacts that a model computes from charges, shape (n, n_electrode), pC."""
    return errors([predictor.predict(row) for row in charge], truth)


def rejected_share(problem: CalibrationProblem, predictor: Predictor, truth: np.ndarray, charge: np.ndarray) -> float:
    """Return the share of the checks that reject a model, each with other presses and other errors of the rig."""
    rng = np.random.default_rng(0)

    def is_rejected() -> bool:
        rows = rng.choice(len(truth), CHECKED_PRESSES, replace=False)
        presses = measured_presses(problem, with_rig_errors(truth[rows], rng, CHECK_SCALE), charge[rows], CHECK_SCALE)
        return check_presses(predictor, presses).fits is False

    return float(np.mean([is_rejected() for _ in range(CHECKS)]))


class Bench:
    """One film, from its presses to the errors of its models.

    Attributes:
        problem: The calibration problem.
        contact: Measured contacts (x, y, F) of the presses, shape (PRESSES, 3), mm and N.
        charge: Their charges with noise, shape (PRESSES, n_electrode), pC.
        later_contact: True contacts of the touches and of the contacts whose errors are measured, shape
            (TOUCHES + CONTACTS, 3).
        later_charge: Their charges without noise by the change of the pretension, MPa.
        rng: Random number generator of the errors and of the noise.
    """

    def __init__(
        self,
        problem: CalibrationProblem,
        kind: Unevenness,
        changes: list[float],
        gain_noise: float,
        seed: int,
        executor: Executor,
        folder: str,
    ) -> None:
        """Draw a film, solve its presses, and measure them.

        Args:
            problem: The calibration problem.
            kind: Kind of the film.
            changes: Changes of the pretension, MPa.
            gain_noise: True noise relative to the charge, which the calibration does not know.
            seed: Seed of the film, of the errors of the presses and of the noise.
            executor: Executor that runs the solves.
            folder: Folder in which the models are written.
        """
        self.problem = problem
        self.executor = executor
        self._noise = NoiseModel("bench", problem.noise.white, gain_noise)
        self._folder = folder
        self.rng = np.random.default_rng([seed, 51])
        sensor, probe = draw_film(problem, kind, seed)
        contact_rng = np.random.default_rng([seed, 50])
        contact, self.later_contact = (
            np.minimum(draw_contacts(contact_rng, problem.domain, count), (np.inf, np.inf, LARGEST_FORCE_N))
            for count in (PRESSES, TOUCHES + CONTACTS)
        )
        self.later_charge = {}
        for change in changes:
            later = replace(sensor, film=replace(sensor.film, pretension=sensor.film.pretension + change))
            self.later_charge[change] = solve_charges(later, probe, self.later_contact, executor)
        self.contact = with_rig_errors(contact, self.rng)
        self.charge = self._noise.add(solve_charges(sensor, probe, contact, executor), self.rng)

    def calibrated(self, contact: np.ndarray, charge: np.ndarray, problem: CalibrationProblem | None = None):
        """Calibrate a film by presses, and return the result and its model."""
        problem = problem or self.problem
        result = calibrate(measured_presses(problem, contact, charge), problem, executor=self.executor)
        folder = Path(mkdtemp(dir=self._folder)) / "film"
        return result, Predictor(write_calibration(result, folder, executor=self.executor))

    def later(self, change: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the later contacts on the film after a change, and their charges with noise."""
        charge = self.later_charge[change][TOUCHES:]
        return self.later_contact[TOUCHES:], self._noise.add(charge, self.rng)

    def touches(self, change: float) -> np.ndarray:
        """Return the charges of the frames of each touch, with noise, shape (n_touch, n_frame, n_electrode)."""
        charge = self.later_charge[change][:TOUCHES]
        return self._noise.add(np.repeat(charge[:, None], FRAMES, axis=1), self.rng)


def follower_after(predictor: Predictor, touches: np.ndarray) -> FilmFollower:
    """Return a follower that has observed touches frame by frame, 100 frames per second, a second between touches."""
    follower = FilmFollower(Setup(predictor.metadata.electrodes, predictor=predictor))
    host_s = 0.0
    for charges in touches:
        for charge_pC in charges:
            # Every frame counts, whatever its flags, because the figures apply to touches all over the film.
            follower._peak.add_frame(predictor.predict(charge_pC), charge_pC)
            host_s += 0.01
        follower.step(Frame(None, None, (), host_s=host_s))
        host_s += 1.0
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
        "not followed": model_errors(predictor, truth, charge),
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
        rejected = rejected_share(bench.problem, predictor, truth, charge)
        results[f"{count} presses"] = {**model_errors(predictor, truth, charge), "rejected": rejected}
    if not has_all_cases:
        return results

    _, offset_predictor = bench.calibrated(bench.contact, bench.charge + OFFSET_pC)
    results["offset"] = model_errors(offset_predictor, truth, charge + OFFSET_pC)
    contact = bench.contact.copy()
    contact[:, 2] *= 1.0 + HYSTERESIS * np.sign(bench.rng.standard_normal(len(contact)))
    _, hysteresis_predictor = bench.calibrated(contact, bench.charge)
    results["hysteresis"] = model_errors(hysteresis_predictor, truth, charge)

    right_gains = np.ones(len(bench.problem.electrodes))
    wrong_gains = right_gains.copy()
    wrong_gains[0] = LARGER_GAIN
    cases = [(f"{change:+g} MPa", change, right_gains) for change in bench.later_charge]
    for name, change, gains in (*cases, ("gain", 0.0, wrong_gains)):
        draws = [followed_errors(bench, predictor, change, gains) for _ in range(DRAWS)]
        for way in draws[0]:
            results[f"{way}, {name}"] = mean_values([draw[way] for draw in draws])
        if change != 0.0:
            problem = replace(bench.problem, earlier=result.film.drifted())
            mean_charge = bench.touches(change).mean(axis=1)
            _, again = bench.calibrated(np.full((TOUCHES, 3), np.nan), mean_charge, problem)
            results[f"again, {name}"] = model_errors(again, *bench.later(change))
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
        sensor="four-25um-biaxial",
        radius=DEFAULT_RADIUS,
    )
    problem = CalibrationProblem(load_sensor(asked.sensor), Circle(1.0), asked.radius)
    changes = [float(change) for change in asked.changes.split(",")]
    counts = [int(count) for count in asked.presses.split(",")]
    all_results = []
    with local_workers(2) as executor, TemporaryDirectory() as folder:
        for seed in (int(text) for text in asked.seeds.split(",")):
            bench = Bench(problem, FILMS[asked.films], changes, asked.gain_noise, seed, executor, folder)
            report_progress("film", {"seed": float(seed)})
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
