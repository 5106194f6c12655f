"""Split of presses into three parts: for training, for validation and for the test."""

from dataclasses import dataclass, replace

from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.simulate import ChargeMap, Domain, NoiseModel
from isocharge.simulate.forward.charge_map import within
from isocharge.train.data.channel_noise import ChannelNoise
from isocharge.train.data.charge_fit import fit_charge_series
from isocharge.train.data.invertible_domain import invertible_domain
from isocharge.train.data.misfit_charges import misfit_noise
from isocharge.train.data.presses import LabelledPresses, held_out, split_by_position
from isocharge.train.training.config import TrainingConfig
from isocharge.train.training.features import WhitenedFeatures
from isocharge.train.training.source import TrainingData

VALIDATION_FRACTION = 0.5
"""Fraction of the positions for validation, relative to the fraction of the positions for the test, dimensionless."""

SIGNED_FEATURE_SCALE = 0.1
"""Charge above which features of charges of both signs are logarithmic, dimensionless.

It is relative to the charge above which the noise is proportional to the charge. On a taut uniaxial film, the value 0.1
gave smaller position errors than the value 1.
"""


@dataclass(frozen=True)
class Split:
    """Presses that are split by position into presses for training, for validation and for the test.

    In the domain of the presses, the map from contacts to charges can be inverted.

    Attributes:
        domain: Contacts for which the network is trained.
        train: Presses for training.
        validation: Presses that choose the degrees of the charge field.
        test: Presses for measuring errors.
        field: Map from contacts to charges. It is fitted to the presses of the domain, or to all presses if this fit is
            more accurate.
        cautions: Sentences about folds of the map and about contacts with the same charges.
        folded_charges: Approximation of the charges by a series, which includes the region where the map folds; None if
            the map does not fold.
    """

    domain: Domain
    train: LabelledPresses
    validation: LabelledPresses
    test: LabelledPresses
    field: ChargeMap
    cautions: tuple[str, ...]
    folded_charges: ChargeSeries | None

    @classmethod
    def by_position(cls, data: TrainingData, training: TrainingConfig) -> "Split":
        """Split presses into three parts for training, validation and test, and fit a charge field to them.

        A charge field is a smooth map from contacts to charges. The map folds where different contacts have the same
        charges. A first field is fitted to all presses and determines the largest disk in which the map certainly does
        not fold. Only the presses within this disk are distributed among the three parts. If the map folds or the
        presses are measured, a second field is fitted to the presses for training.

        Args:
            data: Presses of the sensor.
            training: Fractions of the presses, noise and seed.
        """
        # Fit the first field, and determine the domain without folds.
        presses = data.presses
        electrode_names = data.sensor.electrode_names
        field_train, field_validation = split_by_position(presses, training.hold_out, training.seed)
        first_field = data.field or fit_charge_series(data.domain, electrode_names, field_train, field_validation)
        domain, cautions = invertible_domain(first_field, presses, misfit_noise(training.noise_model))
        is_folded = domain != data.domain  # `invertible_domain` reduces the domain only if the map folds
        used_presses = presses.within(domain.radius) if is_folded else presses

        train, validation, test = _split_presses(used_presses, training)

        # A second field, without the test presses, is fitted in two cases. If the map folds, the first field was also
        # fitted to presses beyond the fold. Then the more accurate of both fields is used. If the presses are measured,
        # the first field was also fitted to test presses.
        field: ChargeMap = first_field
        if is_folded or presses.measured:
            second_field = fit_charge_series(domain, electrode_names, train, validation)
            is_first_better = is_folded and first_field.charge_std < second_field.charge_std
            field = within(first_field, domain.radius) if is_first_better else second_field
        folded_charges = replace(first_field, is_folded=True) if is_folded else None
        return cls(domain, train, validation, test, field, cautions, folded_charges)

    def features(self, noise: NoiseModel) -> WhitenedFeatures:
        """Fit the input features to the training presses.

        The features are logarithms of the charges if all charges are positive. Otherwise, they are inverse hyperbolic
        sines of charge / typical charge, which are linear for small charges and logarithmic for large charges.

        Args:
            noise: Noise of the charges, which determines the typical charges.
        """
        charge = self.train.charge
        has_both_signs = self.train.signed or self.validation.signed or self.test.signed
        if not has_both_signs:
            return WhitenedFeatures.fit_logarithms(charge)
        channel_noise = ChannelNoise.alike(noise, charge.shape[1])
        # The typical charge of a channel is the charge above which the noise would be proportional to the charge if the
        # white noise were multiplied by `SIGNED_FEATURE_SCALE`.
        smaller_noise = replace(channel_noise, white=SIGNED_FEATURE_SCALE * channel_noise.white)
        return WhitenedFeatures.fit_signed(charge, smaller_noise.transition_charge(charge))


def _split_presses(
    presses: LabelledPresses, training: TrainingConfig
) -> tuple[LabelledPresses, LabelledPresses, LabelledPresses]:
    """Split presses by position into three parts: for training, for validation and for the test.

    If the presses are measured, their positions alone determine which presses are used for the test (`held_out`).
    Simulated presses are chosen for the test at random. The presses for validation are always chosen at random.

    Args:
        presses: Presses to split.
        training: Fraction of the positions for the test, and the seed. Measured presses do not use this fraction for
            the test, but half of it for the validation.

    Returns:
        Presses for training, for validation and for the test.
    """
    if presses.measured:
        is_test = held_out(presses.contact)
        remaining = presses[~is_test]
        test = presses[is_test]
    else:
        remaining, test = split_by_position(presses, training.hold_out, training.seed)
    validation_share = VALIDATION_FRACTION * training.hold_out
    # With another seed, the choice of the validation presses is independent of the choice of the test presses.
    train, validation = split_by_position(remaining, validation_share, training.seed + 1)
    return train, validation, test
