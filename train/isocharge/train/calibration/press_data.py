"""Measured presses in the form that the estimator needs: charges and contacts with their standard deviations."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from isocharge.common.arrays import Array, Booleans
from isocharge.serve.presses.measured_presses import MeasuredPresses
from isocharge.simulate import Domain, NoiseModel

UNKNOWN_STD = np.inf
"""Standard deviation of a value that was not measured."""


class PressErrors(NamedTuple):
    """Standard deviations of the errors of presses, which may be larger than the user states.

    Attributes:
        noise: Noise of the charges.
        position_ratio: Standard deviation of the positions, relative to the stated one.
        force_scatter: Standard deviation of a further error of the forces, relative to the force.
    """

    noise: NoiseModel
    position_ratio: float = 1.0
    force_scatter: float = 0.0


@dataclass(frozen=True)
class PressData:
    """Measured presses.

    Attributes:
        charge: Charges, shape (n, n_electrode), pC; zero if unknown.
        charge_std: Standard deviations of the noise, shape (n, n_electrode), pC; infinite if the charge is unknown.
        noise: Noise of the charges, from which these standard deviations follow.
        contact: Measured contacts (x, y, ln F), shape (n, 3); the middle of the domain if unknown.
        contact_std: Standard deviations of the contacts, shape (n, 3); infinite if unknown.
        time: Time of each press in the session, from -0.5 to 0.5, shape (n,).
    """

    charge: Array
    charge_std: Array
    noise: NoiseModel
    contact: Array
    contact_std: Array
    time: Array

    @classmethod
    def of(cls, presses: MeasuredPresses, noise: NoiseModel, domain: Domain) -> "PressData":
        """Convert presses, whose electrodes have the order of the sensor.

        Args:
            presses: The presses; NaN stands for unknown values.
            noise: Noise of the charges.
            domain: Contacts that are possible.
        """
        is_charge_known = np.isfinite(presses.charge_pC)
        charge = np.where(is_charge_known, presses.charge_pC, 0.0)
        log_contact = presses.contact.copy()
        log_contact[:, 2] = np.log(log_contact[:, 2])
        is_contact_known = np.isfinite(log_contact)
        measured_std = np.column_stack([presses.position_std_mm, presses.position_std_mm, presses.force_std])
        count = len(presses)
        return cls(
            charge=charge,
            charge_std=np.where(is_charge_known, noise.sigma(charge), UNKNOWN_STD),
            noise=noise,
            contact=np.where(is_contact_known, log_contact, domain.centre),
            contact_std=np.where(is_contact_known, measured_std, UNKNOWN_STD),
            time=np.arange(count) / max(count - 1, 1) - 0.5,
        )

    def __len__(self) -> int:
        return len(self.charge)

    def __getitem__(self, rows: Booleans) -> "PressData":
        """Return some of the presses. Their times keep their reference."""
        names = ("charge", "charge_std", "contact", "contact_std", "time")
        return replace(self, **{name: getattr(self, name)[rows] for name in names})

    def with_errors(self, errors: PressErrors) -> "PressData":
        """Return presses with stated errors as presses with other errors."""
        noise, position_ratio, force_scatter = errors
        charge_std = np.where(np.isfinite(self.charge_std), noise.sigma(self.charge), UNKNOWN_STD)
        force_std = np.hypot(self.contact_std[:, 2], force_scatter)
        contact_std = np.column_stack([position_ratio * self.contact_std[:, :2], force_std])
        return replace(self, charge_std=charge_std, noise=noise, contact_std=contact_std)


def no_presses(electrodes: tuple[str, ...]) -> MeasuredPresses:
    """Create an empty list of presses for electrodes with the given names."""
    return MeasuredPresses(
        contact=np.empty((0, 3)),
        charge_pC=np.empty((0, len(electrodes))),
        position_std_mm=np.empty(0),
        force_std=np.empty(0),
        electrodes=electrodes,
        lines=(),
    )
