"""Result of a training: a network with all information that a release needs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from isocharge.common.arrays import Array
from isocharge.simulate import Domain, NoiseModel, Sensor
from isocharge.train.data.channel_noise import Noise
from isocharge.train.data.measured_sensor import MeasuredSensor
from isocharge.train.data.misfit_charges import misfit_noise
from isocharge.train.data.outside_presses import OutsidePresses
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.folded_network import FoldedNetwork


@dataclass(frozen=True)
class Provenance:
    """Additional information about the origin of a model.

    The release of a model writes this information in addition to the information that is written for every model.

    Attributes:
        made_with: Additional entries of the metadata.
        files: Contents of additional files in the version folder, by file name.
    """

    made_with: Mapping[str, object] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)


class Answers(NamedTuple):
    """Contacts, standard deviations and misfits that a network estimates from the charges of n presses.

    Attributes:
        contact: Contacts (x, y, F), shape (n, 3), mm and N.
        std: Standard deviations of the contacts, shape (n, 3), mm and N.
        misfit: Misfits, shape (n, 1), in standard deviations of the noise.
    """

    contact: Array
    std: Array
    misfit: Array


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """A trained network, the presses of its training, and the conditions for which it was trained.

    Attributes:
        network: The network in NumPy.
        sensor: The sensor whose charges are the inputs.
        probes: Notations of the probes.
        domain: Contacts for which the network was trained.
        noise: Noise for which the network was trained.
        test: Presses for measuring errors. The network was trained on other presses, unless `cross_validated` is given.
        sha256: Checksum of the training data.
        provenance: Additional information for the release.
        cautions: Sentences that users of the network should read.
        cross_validated: Answers to the charges of `test` by networks that were not trained on these presses; None if
            `network` itself was not trained on them.
        outside: Presses outside the working area; None if they were not simulated.
        yield_force_N: Force at which the film yields under the sharpest of the probes, N. None if the force is unknown
            or above the range of forces.
        is_force_constant: Whether the network always answers the same force, because all presses have this force or no
            press has a known force.
    """

    network: FoldedNetwork
    sensor: Sensor | MeasuredSensor
    probes: tuple[str, ...]
    domain: Domain
    noise: Noise
    test: LabelledPresses
    sha256: str
    provenance: Provenance
    cautions: tuple[str, ...] = ()
    cross_validated: Answers | None = None
    outside: OutsidePresses | None = None
    yield_force_N: float | None = None
    is_force_constant: bool = False

    @property
    def misfit_noise(self) -> Noise:
        """Noise whose standard deviation is the unit of the misfit.

        For simulated presses, this noise is derived from the noise of the training by `misfit_noise`.
        """
        return misfit_noise(self.noise) if isinstance(self.noise, NoiseModel) else self.noise

    def predict(self, charge: Array) -> tuple[Array, Array, Array]:
        """Estimate contacts.

        Args:
            charge: Charges, shape (n, n_electrode), pC.

        Returns:
            Contacts (x, y, F), shape (n, 3), mm and N. Standard deviations of the contacts, shape (n, 3). Misfits,
            shape (n, 1).
        """
        return self.network.predict(charge)
