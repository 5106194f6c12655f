"""Functions of all benchmarks: options, timing of calls in turns, percentiles, and printing of results."""

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bayes.posterior import Posterior

from isocharge.common.arrays import Array
from isocharge.serve import Contact, Predictor
from isocharge.serve.benchmark import Contender, machine, take_turns
from isocharge.serve.frames.frame import Frame
from isocharge.serve.tracking.tracker import Tracker
from isocharge.simulate import ChargeSpline, Circle, ForwardMap, NoiseModel, Sweep
from isocharge.simulate.sensor.sensor_file import sensor_from_dict
from isocharge.train.data.contact_errors import contact_error_statistics, position_error, rms


def options(page: str, model: str = "three-25um-biaxial", **more: Any) -> argparse.Namespace:
    """Parse the options of a benchmark of a model.

    Args:
        page: Description of the benchmark for `--help`.
        model: Default of the option `--model`.
        more: Defaults of further options; see `arguments`.
    """
    return arguments(page, model=model, seed=0, **more)


def arguments(page: str, **defaults: Any) -> argparse.Namespace:
    """Parse the options of a benchmark.

    Args:
        page: Description of the benchmark for `--help`.
        defaults: Default of each option by its name, which also determines the type of the option. An option with the
            default False is a switch, and an option with the default None is a path.
    """
    parser = argparse.ArgumentParser(description=page, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in defaults.items():
        option = "--" + name.replace("_", "-").lower()
        if default is False:
            parser.add_argument(option, dest=name, action="store_true")
        else:
            option_type = Path if default is None else type(default)
            parser.add_argument(option, dest=name, default=default, type=option_type, help="%(default)s")
    return parser.parse_args()


def print_results(name: str, asked: argparse.Namespace, results: dict[str, Any]) -> None:
    """Print the options of a benchmark, the machine, and the results by title as one JSON object.

    Args:
        name: Name of the benchmark.
        asked: Options of the benchmark.
        results: Results by title: a value, a list of rows, or a dictionary of values.
    """
    about = {"benchmark": name, **vars(asked), "machine": machine()}
    print(json.dumps(about | {"results": results}, indent=1, default=str))


def model_film(predictor: Predictor, radius_mm: float) -> ForwardMap:
    """Simulate the charges of a circle of 1 mm on the sensor of a model, up to a distance from the centre."""
    metadata = predictor.metadata
    sensor = sensor_from_dict(dict(metadata.sensor))
    return ForwardMap.build(sensor, Circle(1.0), radius_mm, metadata.force_range_N)


def inner_radius_mm(predictor: Predictor) -> float:
    """Return the radius of the largest disk within the working area of a model, mm."""
    return math.sqrt(predictor.validity.inscribed_radius_squared_mm2)


@dataclass(frozen=True)
class LimitedPresses:
    """Presses with noise, and the estimates with the smallest mean square errors (the Bayes limit).

    Attributes:
        truth: Contacts (x, y, F), shape (n, 3), mm and N.
        charge: Their charges with noise, shape (n, n_electrode), pC.
        posterior_mean: Posterior means of the contacts from these charges, shape (n, 3).
    """

    truth: Array
    charge: Array
    posterior_mean: Array

    @classmethod
    def draw(cls, film: ForwardMap, radius: float, count: int, noise: NoiseModel, seed: int = 1) -> "LimitedPresses":
        """Draw a number of presses within a radius, mm, over the forces of a film, and compute the limit."""
        truth = Sweep(radius, film.domain.force_range, count, seed).contacts()
        charge = noise.add(film.charges(truth), np.random.default_rng([seed, 1]))
        posterior_mean, _ = Posterior(ChargeSpline.of(film), noise, radius).mean_and_std(charge)
        return cls(truth, charge, posterior_mean)

    def errors(self, contact: Array) -> dict[str, float]:
        """Return the rms errors of estimated contacts, shape (n, 3), and their ratios to the limit.

        The posterior mean has the smallest mean square error, so the mean square error of another estimate is larger by
        the mean square difference from the posterior mean. The difference scatters much less from press to press than
        the error.
        """
        errors = contact_error_statistics(contact, self.truth)
        limit = contact_error_statistics(self.posterior_mean, self.truth)
        force_difference_percent = 100.0 * (contact - self.posterior_mean)[:, 2] / self.truth[:, 2]
        differences = {
            "position_rms_mm": rms(position_error(contact, self.posterior_mean)),
            "force_rms_percent": rms(force_difference_percent),
        }
        rows = {}
        for name, difference in differences.items():
            ratio = float(np.hypot(1.0, difference / limit[name]))
            rows |= {name: errors[name], f"{name}_over_limit": round(ratio, 4)}
        return rows


def whitened_errors(contact: Array, truth: Array, std: Array, correlation: Array) -> Array:
    """Divide the errors of contacts by their standard deviations, and remove their correlations.

    Args:
        contact: Estimated contacts (x, y, F), shape (n, 3), mm and N.
        truth: True contacts, shape (n, 3).
        std: Stated standard deviations, shape (n, 3).
        correlation: Stated correlations of x and y, x and F, y and F, shape (n, 3).

    Returns:
        Errors, shape (n, 3), which are independent and standard normal if the stated covariances are correct. The first
        two are those of the position alone.
    """
    xy, xf, yf = correlation.T
    one = np.full(len(xy), 1.0 + 1e-6)  # a correlation that float32 rounds to 1 would give a singular matrix
    matrix = np.moveaxis(np.array([[one, xy, xf], [xy, one, yf], [xf, yf, one]]), 2, 0)
    return np.linalg.solve(np.linalg.cholesky(matrix), ((contact - truth) / std)[..., None])[..., 0]


def track_contacts(tracker: Tracker, t_s: Array, contacts: Array, charge: Array) -> list[Frame]:
    """Follow the contacts of one path, from its first frame, and return the frames with the tracked contacts.

    Args:
        tracker: The tracker.
        t_s: Time of each frame, shape (n,), s.
        contacts: Outputs of the model for each frame, shape (n, 10).
        charge: Charges of each frame, shape (n, n_electrode), pC.
    """
    tracker.reset()
    frames = []
    steps_s = np.diff(t_s, prepend=t_s[:1]).tolist()
    for step_s, contact, charge_pC in zip(steps_s, contacts.tolist(), charge, strict=True):
        frame = Frame(None, None, (), dt_s=step_s, charge_pC=charge_pC, contact=Contact(*contact))
        tracker.step(frame)
        frames.append(frame)
    return frames


def report_progress(title: str, result: dict[str, float]) -> None:
    """Print a part of the results to the standard error stream as soon as it is available.

    Args:
        title: What the result belongs to, such as the number of a film.
        result: Values by name.
    """
    values = ", ".join(f"{key} {value:.4g}" for key, value in result.items())
    print(f"{title}: {values}", file=sys.stderr, flush=True)


def percentiles(values: Any, shares: tuple[float, ...], digits: int = 1) -> dict[str, float]:
    """Return rounded percentiles of values by name, such as "p50"; nothing if there are no values."""
    if not len(values):
        return {}
    return {f"p{share:g}": round(float(np.percentile(values, share)), digits) for share in shares}


def in_turns(contenders: Sequence[Contender], seconds: float) -> list[dict[str, Any]]:
    """Call functions in turns, and measure the time of each for one press.

    Args:
        contenders: The functions.
        seconds: Duration of the measurement, s.

    Returns:
        For each function its timing, the median of its time for one press, and the ratio to that of the first function.
    """
    timings = take_turns(contenders, seconds)
    medians_us = [timing.p50_us / timing.presses for timing in timings]
    return [
        timing._asdict() | {"p50_us_per_press": median_us, "ratio_p50": median_us / medians_us[0]}
        for timing, median_us in zip(timings, medians_us, strict=True)
    ]
