"""Training time against error over the Bayes limit: the training, the training without its parts, and scikit-learn.

    python tests/benchmarks/bench_fit.py [--sensor three-25um-biaxial] [--radius 8] [--samples 24000] [--presses 1500]
        [--steps 250,600,1500,2000] [--noise reference]

Only the contact network is trained. All methods learn from the same simulated presses and estimate the same fresh
presses with noise. The time is CPU time of one thread, because a busy machine does not change it much. The
Bayes limit takes about 15 ms for each press. It is not accurate for noise that is far below `reference`.
"""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from unittest.mock import patch

import numpy as np
import torch
from shared import LimitedPresses, arguments, print_results, report_progress
from sklearn.compose import TransformedTargetRegressor
from sklearn.decomposition import PCA
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neighbors import KNeighborsRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import FunctionTransformer

from isocharge.common.arrays import Array
from isocharge.common.defaults import DEFAULT_FORCE_RANGE
from isocharge.simulate import Circle, Domain, ForwardMap, NoiseModel, Sweep, load_sensor, noise_model
from isocharge.train import LabelledPresses, NetworkConfig, TrainingConfig
from isocharge.train.data.presses import LOWEST_CHARGE
from isocharge.train.training.contact_training import contact_stage
from isocharge.train.training.fit import threads_and_seed
from isocharge.train.training.network import InverseNetwork, fold_network, logarithmic_features

N_COPIES = 4
"""Number of copies of the presses with noise from which the regressors of scikit-learn learn."""

Predict = Callable[[Array], Array]
"""Function from charges, shape (n, n_electrode), pC, to contacts, shape (n, 3), mm and N."""


class Case:
    """Presses for training and presses for measuring errors.

    Attributes:
        domain: Contacts of both.
        noise: Noise of the charges.
        charge_map: Map from contacts to charges.
        train: Presses for training without noise.
        noisy_train: Copies of these presses with noise.
        test: Presses on which errors are measured.
    """

    def __init__(self, sensor_name: str, radius: float, n_sample: int, n_press: int, noise: NoiseModel) -> None:
        """Simulate the presses and compute the limit."""
        self.domain = Domain(radius, DEFAULT_FORCE_RANGE)
        self.noise = noise
        self.charge_map = ForwardMap.build(load_sensor(sensor_name), Circle(1.0), radius, DEFAULT_FORCE_RANGE)
        contact = Sweep(radius, DEFAULT_FORCE_RANGE, n_sample, 0).contacts()
        self.train = LabelledPresses(contact, self.charge_map.charges(contact))
        noisy_charges = [self.train.noisy(noise, seed) for seed in range(N_COPIES)]
        self.noisy_train = LabelledPresses(np.tile(contact, (N_COPIES, 1)), np.concatenate(noisy_charges))
        self.test = LimitedPresses.draw(self.charge_map, radius, n_press, noise)

    def measure(self, fit: Callable[[], Predict]) -> dict[str, float]:
        """Return the CPU time of a fit, its errors, and their ratios to the limit."""
        started = time.process_time()
        predict = fit()
        seconds = time.process_time() - started
        return {"cpu_s": round(seconds, 2), **self.test.errors(predict(self.test.charge))}


class Adam:
    """The optimiser Adam of PyTorch with the interface of `Soap`."""

    def __init__(self, parameter: torch.Tensor) -> None:
        self._adam = torch.optim.Adam([parameter], betas=(0.9, 0.99))

    def step(self, rate: float) -> None:
        """Update all parameters. A quarter of the rate for SOAP is the best rate for Adam."""
        self._adam.param_groups[0]["lr"] = 0.25 * rate
        self._adam.step()


TRAINING = "isocharge.train.training"
WITHOUT = {
    "SOAP, but Adam": patch(f"{TRAINING}.descent.Soap", Adam),
    "sharpened first layer": patch(f"{TRAINING}.network.TrainablePerceptron.sharpen_first_layer"),
}
"""Changes of the training, each of which removes one part of it, by the name of the part."""


def train(case: Case, steps: int | None, change: AbstractContextManager[object] | None = None) -> Predict:
    """Train as `isocharge train fit` does, or with a change."""
    charge = case.train.charge
    with threads_and_seed(1, 0), change or nullcontext():
        network = InverseNetwork(case.domain, logarithmic_features(charge), charge, NetworkConfig())
        contact_stage(network, case.train, case.noise, TrainingConfig(steps=steps)).run()
    folded = fold_network(network)
    return lambda charge: folded.outputs(charge)[0]


REGRESSORS = {
    "k nearest neighbours": KNeighborsRegressor(20, weights="distance"),
    "gradient boosting": MultiOutputRegressor(HistGradientBoostingRegressor(max_iter=300)),
    "MLPRegressor": MLPRegressor(hidden_layer_sizes=(96, 96, 96), activation="tanh", max_iter=12, random_state=0),
}
"""Regressors of scikit-learn by name. Their inputs are whitened logarithms of the charges."""


def regressor(case: Case, name: str) -> Predict:
    """Fit a regressor of scikit-learn, whose targets are the contacts in unit coordinates."""
    logarithms = FunctionTransformer(lambda charge: np.log(np.maximum(charge, LOWEST_CHARGE)))
    pipeline = make_pipeline(logarithms, PCA(whiten=True), REGRESSORS[name])
    to_unit, to_contact = case.domain.to_unit, case.domain.to_contact
    model = TransformedTargetRegressor(pipeline, func=to_unit, inverse_func=to_contact, check_inverse=False)
    with threads_and_seed(1, 0):
        model.fit(case.noisy_train.charge, case.noisy_train.contact)
    return lambda charge: np.asarray(model.predict(charge))


def main() -> None:
    """Measure all methods, print the results and draw the figure."""
    asked = arguments(
        __doc__,
        sensor="three-25um-biaxial",
        radius=8.0,
        samples=24_000,
        presses=1_500,
        steps="250,600,1500,2000",
        noise="reference",
    )
    case = Case(asked.sensor, asked.radius, asked.samples, asked.presses, noise_model(asked.noise))
    fits: dict[str, Callable[[], Predict]] = {}
    for steps in map(int, asked.steps.split(",")):
        fits[f"training, {steps} steps"] = partial(train, case, steps)
    for name, change in WITHOUT.items():
        fits[f"without {name}"] = partial(train, case, None, change)
    for name in REGRESSORS:
        fits[name] = partial(regressor, case, name)

    train(case, 1)  # the first call of PyTorch takes more than a second
    rows = {}
    for name, fit in fits.items():
        rows[name] = case.measure(fit)
        report_progress(name, rows[name])
    print_results("fit", asked, rows)


if __name__ == "__main__":
    main()
