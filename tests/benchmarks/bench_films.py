"""One network for all films: against networks trained on single films, and its time beside today's released model.

    python tests/benchmarks/bench_films.py [--model NAME] [--films 4] [--seed 0] [--seconds 2] [--json]

Each film is drawn from the prior, swept with solves of its own (no family of films in it) and trained on alone, as
`train fit` does, half a minute each. Both networks answer the same noisy charges of presses that neither was trained
on. Asked: an rms of at most 1.06 times that of the single network, a prediction in at most 1.05 times the time of the
released model of the same sensor, folding under 1 s. `--train FOLDER` times the training, too, from nothing.
"""

import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from shared import in_turns, options, print_results

from isocharge.common.contact_errors import position_error
from isocharge.common.statistics import rms
from isocharge.serve import Predictor, find_model
from isocharge.serve.benchmark import Contender
from isocharge.simulate import Sweep, read_dataset, run_sweep
from isocharge.simulate.execution.workers import cores, local_workers
from isocharge.train import FilmsConfig, FilmsModel, fit, fit_films, read_films, release, release_films

SAMPLES = 24_000


def one_film(films: FilmsModel, parameters: np.ndarray, seed: int) -> dict[str, Any]:
    """Errors of both networks on the same presses of one film, each knowing or trained on that film."""
    sensor, probe = films.prior.film(parameters)
    with TemporaryDirectory() as folder:
        sweep = Sweep(films.domain.radius, films.domain.force_range, SAMPLES)
        single = fit(read_dataset(run_sweep(Path(folder) / "presses", sensor, (probe,), sweep)))
    presses = single.test
    charge = presses.noisy(films.noise, seed)
    answers = {"all films": films.fold(parameters).predict(charge)[0], "alone": single.predict(charge)[0]}
    position = {name: rms(position_error(contact, presses.contact)) for name, contact in answers.items()}
    force = {name: 100.0 * rms(c[:, 2] / presses.contact[:, 2] - 1.0) for name, c in answers.items()}
    return {
        "pretension_MPa": round(float(parameters[0]), 2),
        "position_rms_mm": position,
        "force_rms_percent": force,
        "position_ratio": position["all films"] / position["alone"],
        "force_ratio": force["all films"] / force["alone"],
    }


def contender(name: str) -> Contender:
    """A prediction of one press."""
    predictor = Predictor(find_model(name))
    return Contender(
        name, 1, partial(predictor.predict, [300.0, 310.0, 320.0, 330.0][: len(predictor.metadata.electrodes)])
    )


def folding_time(films: FilmsModel, parameters: np.ndarray) -> float:
    """From parameters to a served model on disk, s: the best of three."""
    times = []
    with TemporaryDirectory() as folder:
        for number in range(3):
            begin = time.perf_counter()
            release(films.film(parameters), Path(folder) / "mine", version=number + 1)
            times.append(time.perf_counter() - begin)
    return min(times)


def training_time(films: FilmsModel, folder: Path) -> float:
    """From nothing to a released folder, s, in a process for each core."""
    config, begin = FilmsConfig(radius=films.domain.radius), time.perf_counter()
    with local_workers(cores()) as executor:
        release_films(fit_films(films.prior, config, executor=executor), folder)
    return time.perf_counter() - begin


def main() -> None:
    asked = options(__doc__, "four-25um-biaxial-films", films=4, seconds=2.0, train=None)
    films = read_films(find_model(asked.model))
    drawn = films.prior.draw(np.random.default_rng(asked.seed), asked.films)
    results: dict[str, Any] = {
        "prediction": in_turns([contender(films.prior.sensor.name), contender(asked.model)], asked.seconds),
        "folding, s": folding_time(films, drawn[0]),
        "films": [one_film(films, parameters, asked.seed) for parameters in drawn],
    }
    if asked.train:
        results["training, s"] = training_time(films, asked.train)
    print_results("films", asked, results)


if __name__ == "__main__":
    main()
