"""Training of a network only on measured presses, for a sensor without a simulation.

For a cross-validation, five networks are trained, each without the presses at a fifth of the places. Each network then
estimates the contacts of the presses that were left out of its training. The errors of the model are computed from
these answers. The answers to held-out presses also determine factors by which the standard deviations are multiplied.
With these factors, the confidence intervals contain the true values as often as they should (split conformal
prediction, Papadopoulos et al., 2002). The mean answer of the five networks has smaller errors than the answer of a
single network. One further network learns this mean answer (Hinton et al., 2015). Only this last network is released,
so the model is as small and fast as the models of simulated sensors.

The noise of the charges is estimated from the presses themselves (`isocharge.train.data.channel_noise`). In every
training step, random noise with half of the estimated size is added to the charges as a regularisation.
"""

import logging
from dataclasses import replace
from statistics import NormalDist

import numpy as np
import torch
from msgspec import structs
from torch import Tensor

from isocharge.common.arrays import Array, Integers
from isocharge.common.errors import PressError, cut
from isocharge.serve.presses.measured_presses import MeasuredPresses, PLACE_STEP_mm
from isocharge.serve.presses.table_file import csv_text
from isocharge.train.data.channel_noise import ChannelNoise, LocalPlanes, median_magnitude
from isocharge.train.data.contact_errors import rms, rounded
from isocharge.train.data.measured_sensor import MIN_FORCE_RATIO, PressedArea, check_measured_presses
from isocharge.train.data.presses import (
    MIN_PLACES,
    MIN_PRESSES,
    N_FOLDS,
    LabelledPresses,
    check_known_columns,
    complete,
    merged_places,
    place_count,
    position_ranks,
    presses_sha256,
)
from isocharge.train.training.config import MANY_ELECTRODE_SIZES, FitConfig, TrainingConfig
from isocharge.train.training.contact_training import contact_stage
from isocharge.train.training.descent import TrainingStage
from isocharge.train.training.fit import Answers, Fitted, threads_and_seed, train_perceptron
from isocharge.train.training.folded_network import LOG_STD, MEAN
from isocharge.train.training.misfit_training import draw_charges, misfit_stage
from isocharge.train.training.network import (
    InverseNetwork,
    as_tensor,
    fold_network,
    signed_features,
)

_log = logging.getLogger(__name__)

CHANNEL_COUNTS = (3, 32)
"""Smallest and largest number of channels."""

DEFAULT_STEPS = 1_200
"""Default number of steps of each training of a contact network. Networks soon overfit presses with noise."""

TRAINING_NOISE_FACTOR = 0.5
"""Noise that is added in every step, relative to the noise of the presses. With a larger factor, the network cannot
resolve the map from charges to contacts. With a smaller factor, the network overfits the presses."""

DISTILLATION_NOISE_FACTORS = (0.0, 0.5, 0.5, 1.0, 1.0, 2.0)
"""Noise that is added to each copy of the presses, relative to the noise of the presses. The last network learns from
these copies."""

PRESSES_FILE = "presses.csv"
"""Name of the file in the version folder with the presses on which the model was trained."""

MAX_FORCE_GAP = 1.0 / 6.0
"""Largest distance between the logarithms of neighbouring forces, relative to the whole range, without a caution."""

UNKNOWN_FORCE_N = 1.0
"""Force that a model states if it was trained on presses without forces, N. The standard deviation of this force has
the same size."""


def fit_presses(
    presses: MeasuredPresses,
    name: str,
    config: FitConfig | None = None,
    *,
    probes: tuple[str, ...] = ("unknown",),
) -> Fitted:
    """Train a network on measured presses of any sensor with 3 to 32 channels.

    Several networks are trained for a cross-validation. One further network learns the mean outputs of these networks
    (distillation), and then learns misfits. A warning is logged if presses are left out. Another warning is logged if
    all presses have nearly the same force, or if no press has a known force. The network then only learns x and y. A
    warning is also logged if there is a wide gap between the forces, as between dead weights.

    Args:
        presses: At least 500 presses at 50 places. Presses with an unknown place or charge are left out. Presses with
            an unknown force are also left out, unless all forces are unknown.
        name: Name of the sensor.
        config: Settings. The settings `noise` and `hold_out` are not used.
        probes: Notations of the probes.

    Returns:
        The network that learned the mean outputs, with everything that a release needs.

    Raises:
        PressError: If there are too few presses or places, fewer than 3 or more than 32 channels, or if
            `check_measured_presses` finds a fault.
        ConfigError: If a setting is out of its range.
        TrainingError: If the loss is not finite.
    """
    # Measured presses are few and noisy. Therefore, the misfit network is trained like a misfit network for many
    # electrodes.
    settings = (config or FitConfig()).checked()
    training = structs.replace(
        settings.training,
        steps=settings.training.steps or DEFAULT_STEPS,
        misfit_steps=settings.training.misfit_steps or MANY_ELECTRODE_SIZES.misfit_steps,
        misfit_charges=settings.training.misfit_charges or MANY_ELECTRODE_SIZES.misfit_charges,
    )
    # Select the presses, and estimate the noise of their charges.
    usable = usable_presses(presses)
    force_std = constant_force_std(usable)  # None if the forces vary
    labelled = LabelledPresses(usable.contact, usable.charge_pC)
    domain = PressedArea.of_contacts(labelled.contact)
    log_force = np.sort(np.log(usable.contact[:, 2]))
    gap = np.diff(log_force)
    widest = gap.argmax()
    made_with: dict[str, object] = {"config": settings.to_dict()}  # for the metadata of the model
    if force_std is not None:
        made_with["constant_force"] = {
            "force_N": rounded(np.exp(domain.centre[2])),
            "force_std": rounded(force_std),
            "is_known": bool(presses.placed.any()),
        }
    elif gap[widest] > MAX_FORCE_GAP * gap.sum():
        # The networks learn that forces in the gap do not occur, and the cross-validation contains no such forces.
        lower_N, upper_N = np.exp(log_force[[widest, widest + 1]])
        caution = (
            f"no press has a force between {lower_N:.3g} and {upper_N:.3g} N, and the model may be wrong there: "
            "measure forces all over the range"
        )
        _log.warning("%s", caution)
        made_with["cautions"] = [caution]
    unit_contact = domain.to_unit(labelled.contact)
    if force_std is not None and force_std >= 1.0:  # the forces are unknown and may vary
        unit_contact[:, 2] = _unit_log_sizes(labelled.charge)
    noise = ChannelNoise.estimate(labelled.charge, unit_contact)
    with threads_and_seed(training.threads, training.seed):
        features = signed_features(labelled.charge, noise.transition_charge(labelled.charge))
        # Cross-validation: train a network for each fold, and compute the answers to the presses of the fold. The first
        # network is the one that is returned. It learns from the networks of the folds.
        network, *fold_networks = (
            InverseNetwork(domain, features, labelled.charge, settings.network, force_std) for _ in range(1 + N_FOLDS)
        )
        fold_of_press = (N_FOLDS * position_ranks(merged_uncertain_places(usable))).astype(int)
        contact, std, misfit = _cross_validate(fold_networks, labelled, unit_contact, fold_of_press, noise, training)
        position_factor, force_factor = std_factors(contact, std, labelled.contact)
        if force_std is not None:
            force_factor = 1.0

        # Train the returned network: its contacts on the mean outputs of the networks of the folds, then its misfits.
        distillation = _distillation_stage(network, fold_networks, labelled, noise, training)
        train_perceptron(distillation, settings)
        examples = _misfit_examples(labelled.charge, unit_contact, noise, training)
        train_perceptron(misfit_stage(network, examples, training), settings)

    # The returned network adds its own error to the misfit. Three charges fit a contact exactly, so that this error is
    # then the whole misfit.
    folded_network = fold_network(network)
    *_, network_misfit = folded_network.outputs(labelled.charge)
    misfit = np.maximum(misfit, network_misfit)
    cross_validated = Answers(contact, std * [position_factor, position_factor, force_factor], misfit)

    made_with["measured"] = {
        "presses": len(labelled),
        "places": place_count(merged_uncertain_places(usable)),
        "folds": N_FOLDS,
        "std_factors": [rounded(position_factor), rounded(force_factor)],
    }
    return Fitted(
        network=folded_network.with_scaled_std(position_factor, force_factor),
        sensor={"name": name, "electrodes": list(usable.electrodes)},
        electrodes=usable.electrodes,
        probes=probes,
        domain=domain,
        noise=noise,
        test=labelled,
        sha256=presses_sha256(usable),
        made_with=made_with,
        # The file contains the presses as they were measured: without merged places, and without assumed forces.
        files={PRESSES_FILE: csv_text(presses[np.isin(presses.lines, usable.lines)].columns).encode()},
        cross_validated=cross_validated,
    )


def usable_presses(presses: MeasuredPresses) -> MeasuredPresses:
    """Return the presses with known place, force and charges, and check that there are enough for a training.

    If no press has a known force, every press gets the force `UNKNOWN_FORCE_N` with a standard deviation of the same
    size. A warning is logged if presses are left out. Another warning is logged if all presses have nearly the same
    force, or if no press has a known force.

    Args:
        presses: All presses of a file.

    Raises:
        PressError: If there are too few presses or places, fewer than 3 or more than 32 channels, or if
            `check_measured_presses` finds a fault.
    """
    channel_names = presses.electrodes
    fewest_channels, most_channels = CHANNEL_COUNTS
    if not fewest_channels <= len(channel_names) <= most_channels:
        raise PressError(
            f"expected {fewest_channels} to {most_channels} channels, got {len(channel_names)} "
            f"({cut(', '.join(channel_names))}): every column without another meaning is one; leave other columns out "
            "of the file"
        )

    is_any_force_known = np.isfinite(presses.contact[:, 2]).any()
    if not is_any_force_known:
        assumed_contact = presses.contact.copy()
        assumed_contact[:, 2] = UNKNOWN_FORCE_N
        # `force_std` is relative to the force, so that 1 stands for a standard deviation of the size of the force.
        presses = replace(presses, contact=assumed_contact, force_std=np.ones(len(presses)))
    check_known_columns(presses)
    usable = presses[complete(presses)]  # the place, the force and all charges of each press are known
    # Positions that differ only by the small errors of an encoder become one position. In the count of places below,
    # positions that differ by little more than their standard deviations also count as one place.
    usable = replace(usable, contact=merged_places(usable.contact))
    usable_places = place_count(merged_uncertain_places(usable))
    if len(usable) < MIN_PRESSES or usable_places < MIN_PLACES:
        raise PressError(
            f"expected at least {MIN_PRESSES} presses at {MIN_PLACES} places with known place, force and charges, got "
            f"{len(usable)} at {usable_places}; measure more, or describe the sensor in a file and use "
            "`isocharge train calibrate`, which needs only a few"
        )
    check_measured_presses(usable)

    left_out_count = len(presses) - len(usable)
    if left_out_count:
        _log.warning("%d of %d presses are left out: an unknown place, force or charge", left_out_count, len(presses))
    if not is_any_force_known:
        _log.warning(
            "no press has a known force: the model learns x and y alone, and always states %g +- %g N",
            UNKNOWN_FORCE_N,
            UNKNOWN_FORCE_N,
        )
    elif constant_force_std(usable) is not None:  # all forces are nearly equal
        _log.warning(
            "all presses have a force of about %.3g N: the model can estimate no other force, and learns x and y alone",
            usable.contact[:, 2].mean(),
        )
    return usable


def merged_uncertain_places(presses: MeasuredPresses) -> Array:
    """Return contacts (x, y, F) in which all presses at one place have the same position, shape (n, 3), mm and N.

    A robot does not return to a place exactly, and the errors of its positions are known from `position_std_mm`.
    Neighbouring positions count as one place if their distance is at most twice the standard deviation of the
    difference between two positions.
    """
    step_mm = 2.0 * np.sqrt(2.0) * np.median(presses.position_std_mm)
    return merged_places(presses.contact, max(PLACE_STEP_mm, step_mm))


def constant_force_std(presses: MeasuredPresses) -> float | None:
    """Return the relative standard deviation of the force if all presses have nearly the same force.

    The variance is the sum of the variance of the forces and the mean of the variances that the presses state.

    Args:
        presses: Presses with known forces.

    Returns:
        The standard deviation, dimensionless; None if the forces vary.
    """
    force = presses.contact[:, 2]
    if force.max() >= MIN_FORCE_RATIO * force.min():
        return None
    return float(np.hypot(np.std(np.log(force)), rms(presses.force_std)))


def _unit_log_sizes(charge: Array) -> Array:
    """Return for each press the logarithm of the common size of its charges, scaled to [-1, 1], shape (n,).

    If the force at a place changes, all charges change by about the same factor, and so does their common size. The
    common size of the charges therefore replaces an unknown force. Otherwise, the effect of the force on the charges
    would be taken for noise.

    Args:
        charge: Charges, shape (n, n_channel), pC.
    """
    size = np.linalg.norm(charge / median_magnitude(charge), axis=1)  # each channel has the same weight
    log_size = np.log(np.maximum(size, np.finfo(float).tiny))
    return np.asarray(np.interp(log_size, [log_size.min(), log_size.max()], [-1.0, 1.0]))


def std_factors(contact: Array, std: Array, truth: Array) -> tuple[float, float]:
    """Compute the factors by which standard deviations must be multiplied to agree with the observed errors.

    With these factors, the intervals of one standard deviation contain 68 % of the true values. If the errors have
    longer tails than a normal distribution, the 95 % intervals contain less than 95 % of the true values.

    Args:
        contact: Contacts (x, y, F), estimated by networks that were not trained on these presses, shape (n, 3), mm and
            N.
        std: Standard deviations of the estimated contacts, shape (n, 3).
        truth: True contacts, shape (n, 3).

    Returns:
        Factors for the position and for the force.
    """
    deviation = np.abs(contact - truth) / std
    one_std_coverage = 2.0 * NormalDist().cdf(1.0) - 1.0
    position_factor = np.quantile(deviation[:, :2], one_std_coverage)
    force_factor = np.quantile(deviation[:, 2], one_std_coverage)
    return float(position_factor), float(force_factor)


def _misfit_examples(charge: Array, unit_contact: Array, noise: ChannelNoise, config: TrainingConfig) -> Array:
    """Draw charges, and compute how much they differ from the charges of the most similar contacts.

    A level is a charge on a scale on which the noise has the standard deviation 1. The charges of contacts are known
    only at the presses. Near each press, the levels are therefore approximated by a linear function of the contact,
    which is called a plane. The most similar contact is searched for on these planes.

    Args:
        charge: Charges of the presses, shape (n, n_electrode), pC.
        unit_contact: Contacts of the presses in unit coordinates, shape (n, 3).
        noise: Noise of the charges.
        config: Number of examples and seed.

    Returns:
        Charges, pC, and differences of the levels, shape (2, n_example, n_electrode).
    """
    planes = LocalPlanes.fit(unit_contact, noise.level(charge))
    _, n_electrode = charge.shape
    count = config.sizes(n_electrode).misfit_charges  # number of sets of charges
    drawn_charge = draw_charges(np.random.default_rng(config.seed), charge, noise, count)
    return np.stack([drawn_charge, planes.residuals(noise.level(drawn_charge))])


def _cross_validate(
    fold_networks: list[InverseNetwork],
    presses: LabelledPresses,
    unit_contact: Array,
    fold_of_press: Integers,
    noise: ChannelNoise,
    config: TrainingConfig,
) -> Answers:
    """Train one network for each fold on the presses of all other folds, and estimate the presses of the fold.

    The folds are the parts into which a cross-validation divides the presses. The contact of a press is the answer of
    the network that was not trained on the press. The misfit is the length of the difference between the level of the
    press and the level of the most similar contact. A level is a charge on a scale on which the noise has the standard
    deviation 1. The most similar contact is searched for on planes: near each press of the other folds, the level is
    approximated by a linear function of the contact.

    Args:
        fold_networks: One network for each fold. The contact perceptrons of the networks are trained.
        presses: All presses.
        unit_contact: Contacts of the presses in unit coordinates, shape (n, 3).
        fold_of_press: Index of the fold of each press, shape (n,).
        noise: Noise of the charges.
        config: Settings. Their seed is the seed of the first fold.

    Returns:
        Contacts, standard deviations and misfits of all presses.
    """
    level = noise.level(presses.charge)
    added_noise = noise.scaled(TRAINING_NOISE_FACTOR)
    # Contacts, standard deviations and misfits, which are filled in fold by fold
    answers = Answers(np.empty_like(unit_contact), np.empty_like(unit_contact), np.empty((len(presses), 1)))
    for fold_index, network in enumerate(fold_networks):
        is_in_fold = fold_of_press == fold_index
        fold_config = structs.replace(config, seed=config.seed + fold_index)
        contact_stage(network, presses[~is_in_fold], added_noise, fold_config).run()  # trains the network in place

        # `fold_network` includes the scaling of inputs and outputs in the layers. Its name does not mean these folds.
        contact, std, *_ = fold_network(network).outputs(presses.charge[is_in_fold])
        answers.contact[is_in_fold] = contact
        answers.std[is_in_fold] = std
        # Compare each level with the nearest point of the planes of the other folds.
        planes_of_others = LocalPlanes.fit(unit_contact[~is_in_fold], level[~is_in_fold])
        residual = planes_of_others.residuals(level[is_in_fold])
        answers.misfit[is_in_fold] = np.linalg.norm(residual, axis=1, keepdims=True)
    return answers


def _distillation_stage(
    network: InverseNetwork,
    fold_networks: list[InverseNetwork],
    presses: LabelledPresses,
    noise: ChannelNoise,
    config: TrainingConfig,
) -> TrainingStage:
    """Define the training of a network on the mean outputs of other networks (distillation).

    The network learns from several copies of each press, whose charges contain noise of different sizes.

    Args:
        network: Network to train.
        fold_networks: Networks whose mean outputs are the targets.
        presses: All presses.
        noise: Noise of the charges.
        config: Number of steps, batch size, learning rate and seed.
    """
    rng = np.random.default_rng(config.seed)
    copies = [noise.scaled(factor).add(presses.charge, rng) for factor in DISTILLATION_NOISE_FACTORS]
    charge = as_tensor(np.concatenate(copies))  # shape (number of copies * number of presses, n_electrode)
    # The target of a row of charges is the mean of the outputs of all fold networks for this row. The outputs are the
    # means of the contact, the logarithms of its standard deviations, and the turns that determine its correlations.
    with torch.no_grad():
        outputs = [torch.cat(fold_network.posterior(charge), dim=1) for fold_network in fold_networks]
    target = torch.stack(outputs).mean(dim=0)  # shape (number of rows, n_output), with the columns MEAN, LOG_STD, turns
    # The loss below is a weighted sum of squared differences from the targets. As in the likelihood of a normal
    # distribution, the weight of a mean is half of its inverse variance. The weights of all other outputs are 1.
    weight = torch.ones_like(target)
    weight[:, MEAN] = 0.5 * torch.exp(-2.0 * target[:, LOG_STD])

    def loss(random: torch.Generator) -> Tensor:
        """Return the weighted squared differences, summed over the outputs and averaged over a random batch of rows."""
        rows = torch.randint(len(charge), (config.batch,), generator=random)
        difference = torch.cat(network.posterior(charge[rows]), dim=1) - target[rows]
        return (weight[rows] * difference**2).sum(dim=1).mean()

    steps = config.sizes(network.features.n_electrode).steps
    return TrainingStage("contact", network.contact, loss, steps, config.learning_rate, config.seed)
