"""One network for all films: against networks trained on single films, and its time beside today's released model.

    python tests/benchmarks/bench_films.py [--model NAME] [--films 4] [--seed 0] [--seconds 2] [--json]

Each film is drawn from the prior, swept with solves of its own (no family of films in it) and trained on alone, as
`train fit` does, half a minute each. Both networks answer the same noisy charges of presses that neither was trained
on. Asked: an rms of at most 1.06 times that of the single network, a prediction in at most 1.05 times the time of the
released model of the same sensor, folding under 1 s. `--train FOLDER` times the training, too, from nothing.
"""

import json
import time
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from shared import options

from isocharge.serve import Predictor, find_model
from isocharge.serve.benchmark import Contender, machine, take_turns
from isocharge.simulate import Sweep, read_dataset, run_sweep
from isocharge.simulate.execution.workers import cores, local_workers
from isocharge.simulate.numerics.statistics import rms
from isocharge.train import FilmsConfig, FilmsModel, fit, fit_films, read_films, release, release_films
from isocharge.train.data.presses import position_error

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
        "pretension_MPa": float(parameters[0]),
        "radius_mm": single.domain.radius,
        "presses": len(presses),
        "position_rms_mm": position,
        "force_rms_percent": force,
        "position_ratio": position["all films"] / position["alone"],
        "force_ratio": force["all films"] / force["alone"],
    }


def prediction_times(model: str, rival: str, seconds: float) -> dict[str, float]:
    """Median time of one prediction, us, in turns."""
    contenders = []
    for name in (model, rival):
        predictor = Predictor(find_model(name))
        charges = [300.0 + 10.0 * k for k in range(len(predictor.metadata.electrodes))]
        contenders.append(Contender(name, 1, partial(predictor.predict, charges)))
    medians = {timing.name: timing.p50_us for timing in take_turns(contenders, seconds)}
    return {**medians, "ratio": medians[model] / medians[rival]}


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
    """Measure and print."""
    chosen = options(__doc__, "four-25um-biaxial-films", films=4, seconds=2.0, train=None)
    films = read_films(find_model(chosen.model))
    drawn = films.prior.draw(np.random.default_rng(chosen.seed), chosen.films)
    record: dict[str, Any] = {
        "machine": machine(),
        "model": chosen.model,
        "seed": chosen.seed,
        "prediction_us": prediction_times(chosen.model, films.prior.sensor.name, chosen.seconds),
        "folding_s": folding_time(films, drawn[0]),
        "films": [one_film(films, parameters, chosen.seed) for parameters in drawn],
    }
    if chosen.train:
        record["training_s"] = training_time(films, chosen.train)
    print(json.dumps(record, indent=1) if chosen.json else summary(record))


def summary(record: dict[str, Any]) -> str:
    """The record as lines for people."""
    lines = [
        f"{film['pretension_MPa']:.2f} MPa: {film['position_rms_mm']['all films']:.4f} mm knowing the film, "
        f"{film['position_rms_mm']['alone']:.4f} mm trained on it ({film['position_ratio']:.3f}); force "
        f"{film['force_rms_percent']['all films']:.3f} and {film['force_rms_percent']['alone']:.3f} % "
        f"({film['force_ratio']:.3f})"
        for film in record["films"]
    ]
    times = ", ".join(f"{name} {value:.3f}" for name, value in record["prediction_us"].items())
    training = [f"training: {record['training_s']:.0f} s"] if "training_s" in record else []
    return "\n".join([*lines, f"prediction, us: {times}", f"folding: {record['folding_s']:.2f} s", *training])


if __name__ == "__main__":
    main()
