"""Training data of a network: simulated presses."""

from dataclasses import dataclass

from isocharge.common.errors import DatasetError
from isocharge.serve.model.charge_series import ChargeSeries
from isocharge.simulate import Dataset, Domain, Sensor
from isocharge.train.data.presses import LabelledPresses, domain_of, outside_presses_of, presses_of, yield_force_of


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
        yield_force_N: Force at which the film yields under the sharpest of the probes, N. None if the force is unknown
            or above the range of forces.
        field: Charges as a function of the contact; None to fit them to `presses`.
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
            DatasetError: If the dataset has too few presses or electrodes, or is measured.
        """
        presses = presses_of(dataset)
        if presses.measured:
            raise DatasetError(
                "expected simulated presses, got a measured dataset, whose manifest has no settings of a simulator; "
                "train with `isocharge train fit DATASET`, or with `fit_presses` in Python"
            )
        return cls(
            sensor=dataset.sensor,
            probes=tuple(sorted({str(probe) for probe in dataset.samples.probe})),
            domain=domain_of(dataset),
            presses=presses,
            sha256=dataset.sha256,
            outside=outside_presses_of(dataset),
            yield_force_N=yield_force_of(dataset),
        )
