"""A network for all films, compared with networks that were trained on single films, and its times.

    python tests/benchmarks/bench_films.py [--model NAME] [--films 4] [--seed 0] [--seconds 2] [--json]

Each film is drawn from the prior and swept with solves of its own, and a network is trained on this film alone as in
`train fit`, which takes half a minute. Both networks estimate the contacts of the same noisy charges, on which neither
was trained. The aims are an rms error of at most 1.06 times that of the single network, a prediction in at most 1.05
times the time of the released model of the same sensor, and a model of a film in less than 1 s. With `--train FOLDER`,
the time of a complete training is measured as well.
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
    """Measure the errors of both networks on the same presses of one film.

    Args:
        films: The network for all films, which gets the parameters of the film.
        parameters: Parameters of the film.
        seed: Seed of the noise.
    """
    sensor, probe = films.prior.film(parameters)
    with TemporaryDirectory() as folder:
        sweep = Sweep(films.domain.radius, films.domain.force_range, SAMPLES)
        single = fit(read_dataset(run_sweep(Path(folder) / "presses", sensor, (probe,), sweep)))
    presses = single.test
    charge = presses.noisy(films.noise, seed)
    answers = {"all films": films.fold(parameters).predict(charge)[0], "alone": single.predict(charge)[0]}
    position = {name: rms(position_error(contact, presses.contact)) for name, contact in answers.items()}
    force = {name: 100.0 * rms(contact[:, 2] / presses.contact[:, 2] - 1.0) for name, contact in answers.items()}
    return {
        "pretension_MPa": round(float(parameters[0]), 2),
        "position_rms_mm": position,
        "force_rms_percent": force,
        "position_ratio": position["all films"] / position["alone"],
        "force_ratio": force["all films"] / force["alone"],
    }


def contender(name: str) -> Contender:
    """Return the prediction of one press by a model, given by its name."""
    predictor = Predictor(find_model(name))
    charge_pC = [300.0 + 10.0 * number for number in range(len(predictor.metadata.electrodes))]
    return Contender(name, 1, partial(predictor.predict, charge_pC))


def folding_time(films: FilmsModel, parameters: np.ndarray) -> float:
    """Return the shortest of three times in which the model of a film is computed and written, s."""
    times = []
    with TemporaryDirectory() as folder:
        for number in range(3):
            begin = time.perf_counter()
            release(films.film(parameters), Path(folder) / "mine", version=number + 1)
            times.append(time.perf_counter() - begin)
    return min(times)


def training_time(films: FilmsModel, folder: Path) -> float:
    """Train a network for all films with one process for each core, and return the time up to its release, s."""
    config = FilmsConfig(radius=films.domain.radius)
    begin = time.perf_counter()
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
