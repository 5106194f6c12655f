"""Training time against error over the Bayes limit: the present training, the training before, and scikit-learn.

    python tests/benchmarks/bench_fit.py [--sensor three-25um-biaxial] [--radius 8] [--samples 24000] [--presses 1500]
        [--steps 250,500,1000,2000] [--former-steps 500,1000,2000,4000,8000] [--figure fit.png] [--json]

Only the contact network is trained. All methods learn from the same simulated presses and estimate the same fresh
presses with `reference` noise. The time is CPU time of one thread, because a busy machine does not change it much. The
Bayes limit takes about 15 ms for each press.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import torch
from bayes.limit import BayesProblem, bayes_estimate
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from shared import arguments, print_results
from sklearn.ensemble import HistGradientBoostingRegressor
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neighbors import KNeighborsRegressor
from sklearn.neural_network import MLPRegressor
from sklearn_rivals import SubsetProcess, log_charge_regressor

from isocharge.common.arrays import Array
from isocharge.simulate import Circle, Domain, Sweep, load_sensor, noise_model
from isocharge.train import LabelledPresses, NetworkConfig, TrainingConfig
from isocharge.train.data.contact_errors import ContactErrorStatistics
from isocharge.train.training.descent import Descent, TrainingStage
from isocharge.train.training.features import WhitenedFeatures
from isocharge.train.training.fit import contact_stage, threads_and_seed
from isocharge.train.training.losses import likelihood_loss, warm_up_loss, with_fresh_noise
from isocharge.train.training.network import InverseNetwork, TrainablePerceptron, as_tensor

NOISE = noise_model("reference")
FORMER_BATCH = 1024
FORMER_RATE = 5e-3
FORMER_WARM_UP_FRACTION = 0.15
FORMER_MUON_RATE_FACTOR = 6.0
"""Learning rate of Muon, relative to that of Adam. The size of a step of Muon does not depend on the gradient."""

FORMER_ADAM_BETAS = (0.9, 0.98)
"""Decay rates of Adam's moving averages of the gradient and of its square."""

N_COPIES = 4
"""Number of copies of the presses with noise from which the regressors of scikit-learn learn."""

Predict = Callable[[Array], Array]
"""Function from charges, shape (n, n_electrode), pC, to contacts, shape (n, 3), mm and N."""


@dataclass(frozen=True)
class Case:
    """Presses for training and presses for measuring errors.

    Attributes:
        domain: Contacts of both.
        train: Presses for training without noise.
        truth: Contacts on which errors are measured, shape (n, 3), mm and N.
        charge: Their charges with noise, shape (n, n_electrode), pC.
        limit: Errors of the posterior mean on these presses.
    """

    domain: Domain
    train: LabelledPresses
    truth: Array
    charge: Array
    limit: ContactErrorStatistics

    @classmethod
    def simulate(cls, sensor_name: str, radius: float, n_sample: int, n_press: int) -> "Case":
        """Simulate the presses and compute the limit."""
        problem = BayesProblem(load_sensor(sensor_name), Circle(1.0), radius, noise=NOISE)
        charge_map = problem.forward_map()
        contact = Sweep(radius, problem.force_range, n_sample, 0).contacts()
        truth = Sweep(radius, problem.force_range, n_press, 1, sampling="random").contacts()
        charge = NOISE.add(charge_map.charges(truth), np.random.default_rng(2))
        estimate, _ = bayes_estimate(problem, charge, charge_map=charge_map)
        return cls(
            domain=Domain(radius, problem.force_range),
            train=LabelledPresses(contact, charge_map.charges(contact)),
            truth=truth,
            charge=charge,
            limit=ContactErrorStatistics.of(estimate, truth),
        )

    def measure(self, fit: Callable[[], Predict]) -> dict[str, float]:
        """Return the CPU time of a fit and the errors over the limit."""
        started = time.process_time()
        predict = fit()
        seconds = time.process_time() - started
        errors = ContactErrorStatistics.of(predict(self.charge), self.truth)
        return {
            "cpu_s": round(seconds, 2),
            "position_over_limit": round(errors.position_rms_mm / self.limit.position_rms_mm, 4),
            "force_over_limit": round(errors.force_rms_percent / self.limit.force_rms_percent, 4),
        }

    @cached_property
    def noisy_train(self) -> LabelledPresses:
        """Copies of the presses for training with noise."""
        charges = [self.train.noisy(NOISE, seed) for seed in range(N_COPIES)]
        return LabelledPresses(np.tile(self.train.contact, (N_COPIES, 1)), np.concatenate(charges))

    def network(self) -> InverseNetwork:
        """Return an untrained network of the default size."""
        return InverseNetwork(self.domain, WhitenedFeatures.fit_logarithms(self.train.charge), NetworkConfig())

    def validation(self) -> LabelledPresses:
        """Return the presses that choose the best weights."""
        return self.train[np.arange(0, len(self.train), 20)]


def present_training(case: Case, steps: int) -> Predict:
    """Train as `isocharge train fit` does."""
    config = TrainingConfig(steps=steps)
    with threads_and_seed(1, 0):
        network = case.network()
        stage = contact_stage(network, case.train, case.validation(), NOISE, config)
        Descent(stage, config.learning_rate, config.patience, config.seed).run()
    return predictor(network)


def muon_and_adam(stage: TrainingStage) -> list[torch.optim.Optimizer]:
    """Return Muon (Jordan et al., 2024) for the weights between hidden layers, and Adam for all other weights.

    The learning rate of each optimiser is the rate of the stage times its `rate_factor`.

    Args:
        stage: The training of a `TrainablePerceptron`.
    """
    network = stage.network
    assert isinstance(network, TrainablePerceptron)
    hidden_matrices = network.hidden_matrices()
    # Tensors are compared by identity, because == compares their elements.
    hidden_ids = {id(matrix) for matrix in hidden_matrices}
    other_parameters = [parameter for parameter in network.parameters() if id(parameter) not in hidden_ids]
    muon = torch.optim.Muon([{"params": hidden_matrices, "rate_factor": FORMER_MUON_RATE_FACTOR}], weight_decay=0.0)
    adam = torch.optim.Adam([{"params": other_parameters, "rate_factor": 1.0}], betas=FORMER_ADAM_BETAS)
    return [muon, adam]


def former_training(case: Case, steps: int) -> Predict:
    """Train with Muon and Adam, an unweighted likelihood and the usual initial weights of PyTorch."""
    with threads_and_seed(1, 0):
        network = case.network()
        layers = [layer.out_features for layer in network.contact.linear_layers()]
        *hidden, n_output = layers
        network.contact = TrainablePerceptron(case.train.charge.shape[1], tuple(hidden), n_output)
        charge = as_tensor(case.train.charge)
        target = as_tensor(case.domain.to_unit(case.train.contact))

        def loss(step: int, random: torch.Generator) -> torch.Tensor:
            rows = torch.randint(len(charge), (FORMER_BATCH,), generator=random)
            mean, log_std = network.posterior(with_fresh_noise(charge[rows], NOISE, random))
            is_warm_up = step < FORMER_WARM_UP_FRACTION * steps
            return (warm_up_loss if is_warm_up else likelihood_loss)(mean, log_std, target[rows])

        def score() -> tuple[float, str]:
            return 0.0, ""

        stage = TrainingStage("former", network.contact, loss, score, steps, optimisers=muon_and_adam)
        descent = Descent(stage, FORMER_RATE, steps, 0)
        for _ in range(steps):
            descent.take_step()
    return predictor(network)


def predictor(network: InverseNetwork) -> Predict:
    """Return the contacts of a network as a function of charges."""

    def predict(charge: Array) -> Array:
        with torch.no_grad():
            contact, _, _ = network(as_tensor(charge))
        return contact.double().numpy()

    return predict


REGRESSORS = {
    "k nearest neighbours": KNeighborsRegressor(20, weights="distance"),
    "gradient boosting": MultiOutputRegressor(HistGradientBoostingRegressor(max_iter=300)),
    "Gaussian process": SubsetProcess(),
    "MLPRegressor": MLPRegressor(hidden_layer_sizes=(96, 96, 96), activation="tanh", max_iter=12, random_state=0),
}
"""Regressors of scikit-learn by name. Their inputs are whitened logarithms of the charges."""


def regressor(case: Case, name: str) -> Predict:
    """Fit a regressor of scikit-learn."""
    model = log_charge_regressor(case.domain, regressor=REGRESSORS[name])
    with threads_and_seed(1, 0):
        model.fit(case.noisy_train.charge, case.noisy_train.contact)
    return lambda charge: np.asarray(model.predict(charge))


def draw(rows: dict[str, dict[str, float]], file: Path) -> None:
    """Draw the excess over the limit against the CPU time, one panel for the position and one for the force."""
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    plain_number = FuncFormatter(lambda value, _: f"{value:g}")
    for axes, quantity in zip(figure.subplots(1, 2), ("position", "force"), strict=True):
        key = f"{quantity}_over_limit"
        for label, marker in (("present", "o-"), ("former", "s-")):
            points = [(row["cpu_s"], 100.0 * (row[key] - 1.0)) for name, row in rows.items() if name.startswith(label)]
            axes.loglog(*zip(*points, strict=True), marker, label=f"{label} training")
        for name in REGRESSORS:
            if name in rows:
                axes.loglog(rows[name]["cpu_s"], 100.0 * (rows[name][key] - 1.0), "x", label=name)
        axes.set_xlabel("CPU time of the training, s")
        axes.set_ylabel(f"{quantity} rms above the Bayes limit, %")
        axes.xaxis.set_major_formatter(plain_number)
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(plain_number)
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.grid(visible=True, which="both", alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(file, dpi=120)


def main() -> None:
    """Measure all methods, print the results and draw the figure."""
    asked = arguments(
        __doc__,
        sensor="three-25um-biaxial",
        radius=8.0,
        samples=24_000,
        presses=1_500,
        steps="250,500,1000,2000",
        former_steps="500,1000,2000,4000,8000",
        figure=None,
        json=False,
    )
    case = Case.simulate(asked.sensor, asked.radius, asked.samples, asked.presses)
    fits: dict[str, Callable[[], Predict]] = {}
    for steps in map(int, asked.steps.split(",")):
        fits[f"present, {steps} steps"] = partial(present_training, case, steps)
    for steps in map(int, asked.former_steps.split(",")):
        fits[f"former, {steps} steps"] = partial(former_training, case, steps)
    _ = case.noisy_train  # computed now, so that the time of the first regressor does not include it
    for name in REGRESSORS:
        fits[name] = partial(regressor, case, name)

    present_training(case, 1)  # the first call of PyTorch takes more than a second
    rows = {}
    for name, fit in fits.items():
        rows[name] = case.measure(fit)
        print(name, rows[name], file=sys.stderr, flush=True)
    if asked.figure is not None:
        draw(rows, asked.figure)
    print_results("fit", asked, rows)


if __name__ == "__main__":
    main()
