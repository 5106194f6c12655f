"""Fit a network to measured presses alone, of a sensor that nobody simulates.

Five networks each leave out a fifth of the places. What they say of the presses there, which they never saw, gives the
errors, and the factor by which the standard deviations have to grow so that intervals hold what they promise (split
conformal prediction, Papadopoulos et al. 2002). Their mean errs less than any one of them, and has seen all places; one
network learns its answers (Hinton et al. 2015) and is as small and fast as those of simulated sensors.

The presses' own noise is learned (`data.channel_noise`). It is added again, at half its size, in every step, against
learning presses by heart.
"""

import logging
from dataclasses import replace
from functools import partial
from importlib import metadata

import numpy as np
import torch
from msgspec import structs
from torch import Tensor

from isocharge.common.arrays import Array, Integers
from isocharge.common.errors import PressError, cut
from isocharge.common.resumable_run import ResumableRun
from isocharge.serve.prediction.measured_presses import MeasuredPresses, presses_text
from isocharge.train.data.channel_noise import ChannelNoise, LocalPlanes
from isocharge.train.data.measured_checks import check_measured_presses
from isocharge.train.data.measured_sensor import LEAST_RANGE, MeasuredSensor, PressedArea
from isocharge.train.data.misfit_charges import draw_charges
from isocharge.train.data.presses import (
    FEWEST,
    FEWEST_POSITIONS,
    LabelledPresses,
    complete,
    folds_by_place,
    presses_sha256,
)
from isocharge.train.training.config import FitConfig, TrainingConfig
from isocharge.train.training.descent import Descent, TrainingStage
from isocharge.train.training.features import WhitenedFeatures
from isocharge.train.training.fit import contact_stage, misfit_stage, teaching_loss, threads_and_seed, train_part
from isocharge.train.training.fitted import Fitted, Provenance
from isocharge.train.training.network import InverseNetwork, as_tensor, fold_network

_log = logging.getLogger(__name__)

FOLDS = 5
"""Networks, and parts of the places of which each leaves out one."""

CHANNELS = (3, 8)
"""Fewest and most channels."""

FIRST_STEPS = 1_200
"""Steps that are tried first, then twice as many as long as that helps: noisy presses are learned by heart soon."""

ADDED_NOISE = 0.5
"""Added to charges in every step, over their own noise: more blurs the map, less is learned by heart."""

TAUGHT_NOISE = (0.0, 0.5, 0.5, 1.0, 1.0, 2.0)
"""Noise added to the copies of the presses that the last network is taught on, over their own."""

PRESSES = "presses.csv"
"""File beside the model: what it was fitted to."""


def fit_presses(
    presses: MeasuredPresses,
    name: str,
    config: FitConfig | None = None,
    *,
    probes: tuple[str, ...] = ("unknown",),
    run: ResumableRun | None = None,
) -> Fitted:
    """Fit a network to measured presses of any sensor with three to eight channels.

    Args:
        presses: From 500 presses at 50 places on; those of which something is unknown are left out.
        name: Of the sensor.
        config: Settings; `steps` are the most that are tried, `noise` and `hold_out` are those of the presses.
        probes: Notations of the probes that pressed.
        run: Keeps the state, so that a killed fit goes on.

    Raises:
        PressError: If there are too few presses or places, not three to eight channels, or a fault that
            `check_measured_presses` finds.
        ConfigError: If a setting is out of its range.
        TrainingError: If the loss is not finite.

    A warning is logged if presses are left out, and if all presses have the same force.
    """
    settings, usable = (config or FitConfig()).checked(), usable_presses(presses)
    known = LabelledPresses(usable.contact, usable.charge_pC, measured=True)
    domain = PressedArea.of(known.contact)
    noise = ChannelNoise.of(known.charge, domain.to_unit(known.contact))
    with threads_and_seed(settings.training.threads, settings.training.seed):
        features = WhitenedFeatures.fit_signed(known.charge, noise.bend(known.charge))
        network, *members = (InverseNetwork(domain, features, settings.network) for _ in range(1 + FOLDS))
        fold = folds_by_place(known.contact, FOLDS)
        steps = _train_members(members, known, fold, noise, settings.training, run)
        judged = [_answers(member, known.charge) for member in members]
        contact, std = (np.choose(fold[:, None], [answer[part] for answer in judged]) for part in range(2))
        position, force = deviation_factors(contact, std, known.contact)
        train_part(_taught_stage(network, members, known, noise, settings.training), network.contact, settings, run)
        draw = partial(_misfit_examples, known, domain, noise, settings.training)
        examples = run.keeping("misfit-charges").submit(draw).result() if run else draw()
        train_part(misfit_stage(network, examples, settings.training), network.misfit_vector, settings, run)
    return Fitted(
        network=fold_network(network.eval()).with_scaled_std(position, force),
        sensor=MeasuredSensor(name, usable.electrodes),
        probes=probes,
        domain=domain,
        noise=noise,
        test=known,
        good=known,
        sha256=presses_sha256(usable),
        provenance=Provenance(
            made_with={
                "config": settings.to_dict(),
                "torch": torch.__version__,
                "measured": {
                    "presses": len(usable),
                    "places": len(np.unique(known.contact[:, :2], axis=0)),
                    "folds": FOLDS,
                    "steps": steps,
                    "std_factors": [float(f"{factor:.4g}") for factor in (position, force)],
                },
            },
            files={PRESSES: presses_text(usable).encode()},
        ),
        asked=domain,
        judged=(contact, std * [position, position, force], _left_out_misfit(known, domain, noise, fold)),
    )


def presses_identity(presses: MeasuredPresses, config: FitConfig) -> dict[str, object]:
    """All that decides about the weights: the identity of a resumable run."""
    return {
        "presses_sha256": presses_sha256(presses),
        "electrodes": list(presses.electrodes),
        "config": config.to_dict(),
        "isocharge": metadata.version("isocharge"),
        "torch": torch.__version__,
    }


def usable_presses(presses: MeasuredPresses) -> MeasuredPresses:
    """Return the presses of which everything is known; errors and warnings as `fit_presses`."""
    names = presses.electrodes
    fewest_channels, most_channels = CHANNELS
    if not fewest_channels <= len(names) <= most_channels:
        raise PressError(
            f"expected {fewest_channels} to {most_channels} channels, got {len(names)} ({cut(', '.join(names))}): "
            "every column without another meaning is one; leave other columns out of the file"
        )

    usable = presses[complete(presses)]
    place_count = len(np.unique(np.round(usable.contact[:, :2], 3), axis=0))
    if len(usable) < FEWEST or place_count < FEWEST_POSITIONS:
        raise PressError(
            f"expected at least {FEWEST} presses at {FEWEST_POSITIONS} places with known place, force and charges, got "
            f"{len(usable)} at {place_count}; measure more, or describe the sensor (--sensor): 50 presses then suffice"
        )
    check_measured_presses(usable)

    left_out_count = len(presses) - len(usable)
    if left_out_count:
        _log.warning("%d of %d presses are left out: an unknown place, force or charge", left_out_count, len(presses))
    force = usable.contact[:, 2]
    if force.max() < LEAST_RANGE * force.min():
        _log.warning("all presses have a force of about %.3g N: the model can estimate no other force", force.mean())
    return usable


def deviation_factors(contact: Array, std: Array, truth: Array) -> tuple[float, float]:
    """Factors of the standard deviations of position and of force with which intervals hold what they promise.

    Each is the geometric mean of two: that with which intervals of 68 % hold 68 % of the presses, and of 95 % 95 %.

    Args:
        contact: Of networks that did not see the presses, (x, y, F), shape (n, 3), mm and N.
        std: Their standard deviations, shape (n, 3).
        truth: The contacts, shape (n, 3).
    """
    off = np.abs(contact - truth) / std
    return _factor(off[:, :2]), _factor(off[:, 2])


def _factor(off: Array) -> float:
    sixty_eight, ninety_five = np.quantile(off, [0.6827, 0.95])
    return float(np.sqrt(sixty_eight * ninety_five / 1.96))


def _train_members(
    members: list[InverseNetwork],
    presses: LabelledPresses,
    fold: Integers,
    noise: ChannelNoise,
    config: TrainingConfig,
    run: ResumableRun | None,
) -> int:
    """Train each on all but its part; the steps that were best for the first are those of all, and are returned."""
    steps = min(FIRST_STEPS, config.steps)

    def descend(number: int, steps: int) -> Descent:
        out, settings = fold == number, structs.replace(config, steps=steps)
        stage = contact_stage(members[number], presses[~out], presses[out], noise.scaled(ADDED_NOISE), settings)
        stage = replace(stage, name=f"contact-{number + 1}-{steps}")
        descent = Descent(stage, config.learning_rate, max(steps // 2, 1), config.seed + number)
        descent.run(run)
        return descent

    start = {name: weight.clone() for name, weight in members[0].contact.state_dict().items()}
    best = descend(0, steps)
    while (doubled := 2 * steps) <= config.steps:
        members[0].contact.load_state_dict(start)
        longer = descend(0, doubled)
        if longer.best >= best.best:
            members[0].contact.load_state_dict(best.best_weights)
            break
        best, steps = longer, doubled
    for number in range(1, len(members)):
        descend(number, steps)
    return steps


def _answers(network: InverseNetwork, charge: Array) -> tuple[Array, Array]:
    """Contacts and standard deviations, mm and N, shapes (n, 3), of charges (n, n_electrode), pC."""
    with torch.no_grad():
        contact, std, _ = network(as_tensor(charge))
    return contact.double().numpy(), std.double().numpy()


def _taught_stage(
    network: InverseNetwork,
    members: list[InverseNetwork],
    presses: LabelledPresses,
    noise: ChannelNoise,
    config: TrainingConfig,
) -> TrainingStage:
    """The mean answers of the members to noisy copies of the presses; the last of them are only watched."""
    rng = np.random.default_rng(config.seed)
    copies = [noise.scaled(factor).add(presses.charge, rng) for factor in TAUGHT_NOISE]
    charge = as_tensor(np.concatenate(copies)[rng.permutation(len(copies) * len(presses))])
    with torch.no_grad():
        answers = [torch.stack(member.posterior(charge)) for member in members]
    mean, log_std = torch.stack(answers).mean(dim=0)
    trained = len(charge) - len(presses) // 2

    def divergence(rows: Tensor | slice) -> Tensor:
        return teaching_loss(*network.posterior(charge[rows]), mean[rows], log_std[rows])

    def loss(_: int, random: torch.Generator) -> Tensor:
        return divergence(torch.randint(trained, (config.batch,), generator=random))

    def score() -> tuple[float, str]:
        left = divergence(slice(trained, None)).item()
        return left, f"{left:.4f} from the mean of {len(members)} networks"

    return TrainingStage("contact", network.contact, loss, score, max(config.steps // 2, 1))


def _misfit_examples(
    presses: LabelledPresses, domain: PressedArea, noise: ChannelNoise, config: TrainingConfig
) -> Array:
    """Charges of all kinds, pC, and how far they are from those of any press, in standard deviations of the noise.

    Returns:
        Charges and residuals, shape (2, misfit_charges, n_electrode).
    """
    rng, count = np.random.default_rng(config.seed), config.misfit_charges
    planes = LocalPlanes.through(domain.to_unit(presses.contact), noise.level(presses.charge))
    chosen = presses.charge[rng.integers(len(presses), size=count)]
    charge = draw_charges(rng, chosen, presses.charge, noise)[1]
    return np.stack([charge, planes.residuals(noise.level(charge))])


def _left_out_misfit(presses: LabelledPresses, domain: PressedArea, noise: ChannelNoise, fold: Integers) -> Array:
    """Misfit of each press from the presses of the other folds, shape (n, 1)."""
    unit, level, misfit = domain.to_unit(presses.contact), noise.level(presses.charge), np.empty((len(presses), 1))
    for number in range(FOLDS):
        out = fold == number
        residual = LocalPlanes.through(unit[~out], level[~out]).residuals(level[out])
        misfit[out] = np.linalg.norm(residual, axis=1, keepdims=True)
    return misfit
