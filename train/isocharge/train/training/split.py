"""Split of presses into two parts: for training and for the test."""

from dataclasses import dataclass, replace

from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.simulate import ChargeMap, Domain, NoiseModel
from isocharge.simulate.forward.charge_map import within
from isocharge.train.data.channel_noise import ChannelNoise
from isocharge.train.data.charge_fit import fit_charge_series
from isocharge.train.data.invertible_domain import invertible_domain
from isocharge.train.data.misfit_charges import misfit_noise
from isocharge.train.data.presses import LabelledPresses, split_by_position
from isocharge.train.training.config import TrainingConfig
from isocharge.train.training.features import WhitenedFeatures
from isocharge.train.training.source import TrainingData

SIGNED_FEATURE_SCALE = 0.1
"""Charge above which features of charges of both signs are logarithmic, dimensionless.

It is relative to the charge above which the noise is proportional to the charge. On a taut uniaxial film, the value 0.1
gave smaller position errors than the value 1.
"""


@dataclass(frozen=True)
class Split:
    """Presses that are split by position into presses for training and for the test.

    In the domain of the presses, the map from contacts to charges can be inverted.

    Attributes:
        domain: Contacts for which the network is trained.
        train: Presses for training.
        test: Presses for measuring errors.
        field: Map from contacts to charges, which is fitted to all presses.
        cautions: Sentences about folds of the map and about contacts with the same charges.
        folded_charges: Approximation of the charges by a series, which includes the region where the map folds; None if
            the map does not fold.
    """

    domain: Domain
    train: LabelledPresses
    test: LabelledPresses
    field: ChargeMap
    cautions: tuple[str, ...]
    folded_charges: ChargeSeries | None

    @classmethod
    def by_position(cls, data: TrainingData, training: TrainingConfig) -> "Split":
        """Split presses into two parts for training and for the test, and fit a charge field to them.

        A charge field is a smooth map from contacts to charges. The map folds where different contacts have the same
        charges. The field is fitted to all presses and determines the largest disk in which the map certainly does not
        fold. Only the presses within this disk are distributed among the two parts.

        Args:
            data: Presses of the sensor.
            training: Fractions of the presses, noise and seed.
        """
        # Fit the field, and determine the domain without folds.
        presses = data.presses
        electrode_names = data.sensor.electrode_names
        field_train, field_validation = split_by_position(presses, training.hold_out, training.seed)
        whole_field = data.field or fit_charge_series(data.domain, electrode_names, field_train, field_validation)
        domain, cautions = invertible_domain(whole_field, presses, misfit_noise(training.noise_model))
        is_folded = domain != data.domain  # `invertible_domain` reduces the domain only if the map folds
        used_presses = presses.within(domain.radius) if is_folded else presses

        train, test = split_by_position(used_presses, training.hold_out, training.seed)
        field = within(whole_field, domain.radius) if is_folded else whole_field
        folded_charges = replace(whole_field, is_folded=True) if is_folded else None
        return cls(domain, train, test, field, cautions, folded_charges)

    def features(self, noise: NoiseModel) -> WhitenedFeatures:
        """Fit the input features to the training presses.

        The features are logarithms of the charges if all charges are positive. Otherwise, they are inverse hyperbolic
        sines of charge / typical charge, which are linear for small charges and logarithmic for large charges.

        Args:
            noise: Noise of the charges, which determines the typical charges.
        """
        charge = self.train.charge
        has_both_signs = self.train.signed or self.test.signed
        if not has_both_signs:
            return WhitenedFeatures.fit_logarithms(charge)
        channel_noise = ChannelNoise.alike(noise, charge.shape[1])
        # The typical charge of a channel is the charge above which the noise would be proportional to the charge if the
        # white noise were multiplied by `SIGNED_FEATURE_SCALE`.
        smaller_noise = replace(channel_noise, white=SIGNED_FEATURE_SCALE * channel_noise.white)
        return WhitenedFeatures.fit_signed(charge, smaller_noise.transition_charge(charge))
