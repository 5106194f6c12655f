"""A fitted network: what it answers, what it is for, where it comes from."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from isocharge.common.arrays import Array
from isocharge.simulate import Domain, NoiseModel, Sensor
from isocharge.train.data.channel_noise import Noise
from isocharge.train.data.measured_sensor import MeasuredSensor
from isocharge.train.data.misfit_charges import misfit_noise
from isocharge.train.data.presses import LabelledPresses
from isocharge.train.training.folded_network import FoldedNetwork


@dataclass(frozen=True)
class Provenance:
    """What a released model says about its origin, beside what every model says.

    Attributes:
        card: A section for the card, in Markdown.
        made_with: Entries for the metadata.
        files: More files for the version folder, by name.
    """

    card: str = ""
    made_with: Mapping[str, object] = field(default_factory=dict)
    files: Mapping[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class Fitted:
    """A fitted network, and what it is for.

    Attributes:
        network: The network as plain layers in NumPy.
        sensor: The sensor whose charges it takes.
        probes: Notations of the probes.
        domain: The contacts that it knows.
        noise: Noise that it was trained for.
        test: Presses that it is judged by; it did not learn from them, or see `judged`.
        good: Presses of which 1 % may have a misfit above the alarm's.
        sha256: Checksum of what it was fitted to.
        provenance: For the release.
        asked: The domain that was asked for; larger than the network's where the map folds.
        cautions: What users of the network should know, a sentence each.
        judged: Contacts and standard deviations, mm and N, shapes (n, 3), and misfits, shape (n, 1), of `test` without
            what was learned from a press's own place; None where this network did not see `test`.
    """

    network: FoldedNetwork
    sensor: Sensor | MeasuredSensor
    probes: tuple[str, ...]
    domain: Domain
    noise: Noise
    test: LabelledPresses
    good: LabelledPresses
    sha256: str
    provenance: Provenance
    asked: Domain
    cautions: tuple[str, ...] = ()
    judged: tuple[Array, Array, Array] | None = None

    @property
    def misfit_noise(self) -> Noise:
        """The unit of the misfit."""
        return misfit_noise(self.noise) if isinstance(self.noise, NoiseModel) else self.noise

    def predict(self, charge: Array) -> tuple[Array, Array, Array]:
        """Charges (n, n_electrode), pC, to contact (n, 3), mm and N, standard deviations (n, 3), and misfit (n, 1)."""
        return self.network.predict(charge)
