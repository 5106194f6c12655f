"""What a network is fitted to: simulated presses, measured ones, or the answers of another model."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.simulate import Dataset, Domain, Sensor
from isocharge.train.data.measured_checks import check_measured_dataset
from isocharge.train.data.presses import LabelledPresses, domain_of, presses_of
from isocharge.train.training.fitted import Provenance
from isocharge.train.training.network import as_tensor


@dataclass(frozen=True)
class Teacher:
    """A model whose answers a smaller one learns.

    A press says where it was, but not what its noisy charges tell; the answer of a good model is that, without the
    scatter of single presses. So a small network learns faster from answers than from presses (Hinton et al. 2015).

    Attributes:
        label: Its name and version.
        sha256: Of its file.
        answer: Charges (n, n_electrode), pC, to contact (n, 3), mm and N, and standard deviations (n, 3).
    """

    label: str
    sha256: str
    answer: Callable[[Array], tuple[Array, Array]]

    def posterior(self, charge: Tensor, domain: Domain) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation of the domain's unit coordinates, each (n, 3)."""
        contact, std = self.answer(charge.double().numpy())
        relative = np.column_stack([std[:, :2], std[:, 2] / contact[:, 2]]) / domain.scale
        return as_tensor(domain.to_unit(contact)), as_tensor(np.log(relative))


@dataclass(frozen=True, kw_only=True)
class TrainingData:
    """What one network is fitted to, and what it is judged by.

    Attributes:
        sensor: What was pressed.
        probes: Notations of the probes that pressed.
        domain: The contacts that the network shall know; it knows fewer where the map folds.
        presses: Simulated ones are clean, and noise is added while training. To measured ones it is added as well,
            against learning them by heart.
        sha256: Checksum of the presses.
        test: Measured presses to judge by; by default a part of `presses` is held out.
        teacher: A model whose answers are learned; by default the contacts of the presses are.
        provenance: For the release.
    """

    sensor: Sensor
    probes: tuple[str, ...]
    domain: Domain
    presses: LabelledPresses
    sha256: str
    test: LabelledPresses | None = None
    teacher: Teacher | None = None
    provenance: Provenance = field(default_factory=Provenance)

    @classmethod
    def of(cls, dataset: Dataset) -> "TrainingData":
        """Return the training data of a dataset, simulated or measured.

        Raises:
            DatasetError: If the dataset cannot train a network, for example because of a copied channel.
        """
        presses = presses_of(dataset)
        if presses.measured:
            check_measured_dataset(dataset)
        return cls(
            sensor=dataset.sensor,
            probes=tuple(sorted({str(probe) for probe in dataset.samples.probe})),
            domain=domain_of(dataset),
            presses=presses,
            sha256=dataset.sha256,
        )
