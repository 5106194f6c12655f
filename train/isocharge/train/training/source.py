"""Training data of a network: simulated presses, measured presses, or the answers of another model."""

from collections.abc import Callable
from dataclasses import dataclass
from dataclasses import field as dataclass_field

from torch import Tensor

from isocharge.common.arrays import Array
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.simulate import Dataset, Domain, Sensor
from isocharge.train.data.measured_checks import check_measured_dataset
from isocharge.train.data.presses import LabelledPresses, domain_of, outside_presses_of, presses_of, yield_force_of
from isocharge.train.training.fitted import Provenance
from isocharge.train.training.network import as_tensor


@dataclass(frozen=True)
class Teacher:
    """A model from which a smaller network learns (knowledge distillation, Hinton et al., 2015).

    For given noisy charges, the true contact is only one sample from the posterior distribution of the contact. A good
    model estimates the mean of this distribution without the scatter of single samples. A small network therefore
    learns faster from the answers of such a model than from the true contacts.

    Attributes:
        label: Name and version of the model.
        answer: Function that estimates contacts from charges, shape (n, n_electrode), pC. It returns the contacts,
            shape (n, 3), mm and N.
    """

    label: str
    answer: Callable[[Array], Array]

    def unit_contact(self, charge: Tensor, domain: Domain) -> Tensor:
        """Compute the model's estimates of the unit coordinates.

        The unit coordinates are x, y and ln F after a shift and a scaling, so that each of them ranges from -1 to 1 in
        the domain.

        Args:
            charge: Charges, shape (n, n_electrode), pC.
            domain: Domain that defines the centre and the scale of the unit coordinates.

        Returns:
            Estimated unit coordinates, shape (n, 3).
        """
        return as_tensor(domain.to_unit(self.answer(charge.double().numpy())))


@dataclass(frozen=True, kw_only=True)
class TrainingData:
    """Presses for the training of one network, and presses for the measurement of its errors.

    Attributes:
        sensor: Sensor to which the presses belong.
        probes: Notations of the probes.
        domain: Contacts for which a network is requested. The network gets a smaller domain if the map from contacts to
            charges folds.
        presses: Presses for training. Noise is added to the charges during the training. For measured presses, this is
            a regularisation.
        sha256: Checksum of the presses.
        outside: Presses between the domain and the clamp; None if there are none.
        yield_force_N: Force at which the film yields under the sharpest of the probes, N. None if the force is unknown
            or above the range of forces.
        test: Measured presses for measuring errors; None to hold out a part of `presses`.
        teacher: Model whose answers the network learns; None if it learns the contacts of the presses.
        provenance: Additional information about the origin of the model, for the release.
        field: Charges as a function of the contact; None to fit them to `presses`.
    """

    sensor: Sensor
    probes: tuple[str, ...]
    domain: Domain
    presses: LabelledPresses
    sha256: str
    outside: LabelledPresses | None = None
    yield_force_N: float | None = None
    test: LabelledPresses | None = None
    teacher: Teacher | None = None
    provenance: Provenance = dataclass_field(default_factory=Provenance)
    field: ChargeSeries | None = None

    @classmethod
    def of(cls, dataset: Dataset) -> "TrainingData":
        """Convert a simulated or measured dataset to training data.

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
            outside=outside_presses_of(dataset),
            yield_force_N=yield_force_of(dataset),
        )
