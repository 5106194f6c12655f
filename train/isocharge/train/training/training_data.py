"""Presses for the training and the test of a network.

A network is trained in the largest disk in which the map from contacts to charges certainly does not fold.
"""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.common.errors import DatasetError
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.simulate import ChargeMap, Dataset, Domain, NoiseModel, Sensor
from isocharge.simulate.forward.charge_map import within
from isocharge.simulate.identifiability.working_area import working_area
from isocharge.train.data.channel_noise import ChannelNoise, misfit_noise
from isocharge.train.data.charge_fit import SUFFICIENT_ERROR, fit_charge_series
from isocharge.train.data.presses import (
    YIELD_FORCE,
    LabelledPresses,
    domain_of,
    is_measured,
    presses_of,
    split_by_position,
)
from isocharge.train.training.config import TrainingConfig
from isocharge.train.training.folded_network import ChargeFeatures
from isocharge.train.training.network import logarithmic_features, signed_features

SIGNED_FEATURE_SCALE = 0.1
"""Charge above which the features of charges of both signs are logarithmic, relative to the transition charge.

Above the transition charge, the noise is proportional to the charge. On a taut uniaxial film, the value 0.1 gave
smaller position errors than the value 1.
"""


@dataclass(frozen=True, kw_only=True)
class TrainingData:
    """Presses for the training of one network, and presses for the measurement of its errors.

    Attributes:
        sensor: Sensor to which the presses belong.
        probes: Notations of the probes.
        domain: Contacts for which a network is requested. The network gets a smaller domain if the map from contacts to
            charges folds.
        presses: Presses for training. Noise is added to the charges during the training.
        sha256: Checksum of the presses.
        outside: Presses between the domain and the clamp; None if there are none.
        yield_force_N: Force at which the film yields at the centre under the sharpest of the probes, N. None if the
            force is unknown or above the range of forces.
        field: Charges as a function of the contact; None to fit this function to `presses`.
    """

    sensor: Sensor
    probes: tuple[str, ...]
    domain: Domain
    presses: LabelledPresses
    sha256: str
    outside: LabelledPresses | None = None
    yield_force_N: float | None = None
    field: ChargeSeries | None = None

    @classmethod
    def of(cls, dataset: Dataset) -> "TrainingData":
        """Convert a simulated dataset to training data.

        Raises:
            DatasetError: If the dataset has too few presses or electrodes, only one force, or is measured.
        """
        if is_measured(dataset):
            raise DatasetError(
                "expected simulated presses, got a measured dataset, whose manifest has no settings of a simulator; "
                "write the presses as CSV, and train with `isocharge train fit PRESSES.csv`"
            )
        presses = presses_of(dataset)
        first_force_N = presses.contact[0, 2]
        if (presses.contact[:, 2] == first_force_N).all():
            raise DatasetError(
                f"expected presses with different forces, got {first_force_N:g} N in all of {len(presses)}: a network "
                "would answer this force to every press; sweep a range of forces"
            )
        return cls(
            sensor=dataset.sensor,
            probes=dataset.samples.probes,
            domain=domain_of(dataset),
            presses=presses,
            sha256=dataset.sha256,
            outside=None if dataset.outside is None else LabelledPresses.of(dataset.outside),
            yield_force_N=dataset.manifest.get(YIELD_FORCE),
        )


MAX_ERROR_OF_CERTAIN_FOLD = 2.0 * SUFFICIENT_ERROR
"""Largest relative error of the fitted charges at which a fold counts as certain.

A poor fit has spurious folds in the outer fifth of the domain.
"""

PROBABLE_FOLD_RATIO = 0.7
"""Radius below which a fold of a poor fit is probable, relative to the radius of the domain."""

SEARCHED_RADIUS_RATIO = 0.98
"""Radius within which folds are searched for, relative to the radius of the domain.

At the edge of the domain, the presses do not determine the derivatives of the charges accurately."""

MIN_RADIUS_RATIO = 0.2
"""Smallest radius without folds for which a network can be trained, relative to the radius of the dataset."""


def invertible_domain(
    field: ChargeSeries, presses: LabelledPresses, noise: NoiseModel
) -> tuple[Domain, tuple[str, ...]]:
    """Find the disk on which a network can be trained, and write sentences for the user about ambiguous contacts.

    At a fold, the map from contacts to charges turns back, so that contacts on both sides of the fold have the same
    charges. There are three cases. Without a fold, the disk is the domain of the field. If the fit is poor, its folds
    are not certain, and the disk is also the domain of the field. A sentence then states a fold that is not near the
    edge and is therefore probable. If an accurate fit shows a fold, the disk is reduced to the radius of the fold, and
    a sentence states this.

    Args:
        field: Charge field that was fitted to the presses. `field.charge_std` is the relative error of the fit.
        presses: Presses to which the field was fitted. A sentence states how many of them lie in the disk.
        noise: Noise of good presses. Charges that differ by less than the noise count as equal.

    Returns:
        The domain, which is the disk with the range of forces, and the sentences.

    Raises:
        DatasetError: If the radius of the disk is less than `MIN_RADIUS_RATIO` of the radius of the field.
    """
    requested_radius = field.domain.radius
    area = working_area(within(field, SEARCHED_RADIUS_RATIO * requested_radius), noise, search_pairs=False)
    safe_radius = area.unambiguous_radius  # the smaller of the fold and the searched radius, rounded down
    if not np.isfinite(area.fold_radius):  # no fold in the domain
        return field.domain, ()
    if field.charge_std > MAX_ERROR_OF_CERTAIN_FOLD:
        probable_fold = (
            f"the map from contacts to charges probably folds beyond about {safe_radius:.2g} mm: two contacts give the "
            f"same charges there, and the model, which is trained for {requested_radius:g} mm, confuses them; a fit "
            f"with an error of {100.0 * field.charge_std:.2g} % does not show where: choose a smaller radius, or add "
            "an electrode; in a dataset, more presses of one probe may show it"
        )
        cautions = (probable_fold,) if safe_radius < PROBABLE_FOLD_RATIO * requested_radius else ()
        return field.domain, cautions

    if safe_radius < MIN_RADIUS_RATIO * requested_radius:
        raise DatasetError(
            f"the map from contacts to charges folds {safe_radius:g} mm from the centre, of {requested_radius:g} mm "
            "asked for: beyond, two contacts give the same charges; choose a smaller radius, add an electrode, or take "
            "a biaxial film"
        )
    certain_fold = (
        f"the map from contacts to charges folds beyond {safe_radius:g} mm: two contacts give the same charges there; "
        f"the model is trained for {safe_radius:g} mm, not {requested_radius:g} mm, on "
        f"{len(presses.within(safe_radius))} of {len(presses)} presses; 'serve stream --track' follows contacts to "
        f"{requested_radius:g} mm"
    )
    return field.domain.within(safe_radius), (certain_fold,)


@dataclass(frozen=True)
class Split:
    """Presses for training and presses for the test, which are separated by their positions.

    In the domain of the presses, the map from contacts to charges can be inverted.

    Attributes:
        domain: Contacts for which the network is trained.
        train: Presses for training.
        test: Presses for measuring errors.
        field: Map from contacts to charges, which is fitted to all presses.
        cautions: Sentences about folds of the map and about contacts with the same charges.
        folded_charges: Series that approximates the charges in a domain that includes the region where the map folds;
            None if the map does not fold.
    """

    domain: Domain
    train: LabelledPresses
    test: LabelledPresses
    field: ChargeMap
    cautions: tuple[str, ...]
    folded_charges: ChargeSeries | None

    @classmethod
    def by_position(cls, data: TrainingData, training: TrainingConfig) -> "Split":
        """Split presses into a part for training and a part for the test, and fit a charge field to the presses.

        All presses of one position are in the same part. A charge field is a smooth map from contacts to charges. If
        the data contain a field, no field is fitted. The field folds where it turns back, so that contacts on both
        sides have the same charges. If a fold is certain, only the presses within the disk up to the fold are used.

        Args:
            data: Presses of the sensor.
            training: Fractions of the presses, noise and seed.
        """
        # Fit the field to presses of the whole requested domain, unless the data contain it. Determine the domain
        # without folds, and sentences for the user about folds (`cautions`).
        presses = data.presses
        train, test = split_by_position(presses, training.hold_out)
        noise = misfit_noise(training.noise_model)  # the noise of the training, or `reference` if it has none
        whole_field = data.field or fit_charge_series(
            data.domain, data.sensor.electrode_names, train, test, noise.white
        )
        domain, cautions = invertible_domain(whole_field, presses, noise)
        if domain == data.domain:
            return cls(domain, train, test, whole_field, cautions, folded_charges=None)

        # The field folds. Use only the presses within the smaller domain. The whole field with its folds is kept, too,
        # so that a service can track contacts beyond the fold.
        train, test = split_by_position(presses.within(domain.radius), training.hold_out)
        field = within(whole_field, domain.radius)
        return cls(domain, train, test, field, cautions, folded_charges=replace(whole_field, is_folded=True))

    def features(self, noise: NoiseModel) -> ChargeFeatures:
        """Choose the features of the charges for the training presses.

        The features are logarithms of the charges if all charges are positive. If some charges are not positive, the
        features are inverse hyperbolic sines of charge / typical charge. These features are nearly linear for charges
        below the typical charge of the channel, and nearly logarithmic for charges above it.

        Args:
            noise: Noise of the charges, which determines the typical charges or the lower limit of the charges.
        """
        charge = self.train.charge
        has_both_signs = self.train.has_nonpositive_charges or self.test.has_nonpositive_charges
        if not has_both_signs:
            return logarithmic_features(charge, noise.white)
        channel_noise = ChannelNoise.alike(noise)  # the same noise on every electrode
        # The typical charge is `SIGNED_FEATURE_SCALE` times the transition charge, above which the noise is
        # proportional to the charge. The transition charge is proportional to the white noise, but has a lower limit.
        # The white noise is multiplied instead of the transition charge, so that the limit remains.
        scaled_noise = replace(channel_noise, white=SIGNED_FEATURE_SCALE * channel_noise.white)
        return signed_features(charge, scaled_noise.transition_charge(charge))
