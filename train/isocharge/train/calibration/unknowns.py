"""Layout of the vector of unknowns in a calibration, with a named slice for each kind of unknown.

The first unknowns are the parameters of the film (`film_prior.PARAMETERS` and the gains). After the parameters come
three kinds of coefficients: for the modes of imperfections, for the traces, and for the terms of the discrepancy. The
last unknowns are the nuisances of the session (`nuisances.NUISANCES`). During a fit, parameters are in units of their
prior standard deviations.
"""

from dataclasses import dataclass
from functools import cached_property

from isocharge.train.calibration.discrepancy import TRACE_ANGLES, term_count
from isocharge.train.calibration.nuisances import NUISANCES


@dataclass(frozen=True)
class UnknownLayout:
    """Indices of the parameters, coefficients and nuisances in the vector of unknowns.

    Attributes:
        parameter_names: Names of the film's parameters.
        mode_names: Names of the modes of imperfections.
        electrode_names: Names of the electrodes.
    """

    parameter_names: tuple[str, ...]
    mode_names: tuple[str, ...]
    electrode_names: tuple[str, ...]

    @cached_property
    def parameters(self) -> slice:
        """Parameters of the film."""
        return slice(0, len(self.parameter_names))

    @cached_property
    def modes(self) -> slice:
        """Coefficients of the modes of imperfections."""
        return _after(self.parameters, len(self.mode_names))

    @cached_property
    def traces(self) -> slice:
        """Coefficients of traces that the sensor file does not contain.

        Each electrode has one coefficient for each angle in `TRACE_ANGLES`.
        """
        return _after(self.modes, len(TRACE_ANGLES) * len(self.electrode_names))

    @cached_property
    def terms(self) -> slice:
        """Coefficients of the discrepancy, one for each combination of a term and an electrode.

        In the order of these coefficients, the index of the electrode changes fastest.
        """
        return _after(self.traces, term_count() * len(self.electrode_names))

    @cached_property
    def nuisances(self) -> slice:
        """Nuisances of the session."""
        return _after(self.terms, len(NUISANCES))

    @cached_property
    def coefficients(self) -> slice:
        """All coefficients: those for the modes, for the traces, and for the terms of the discrepancy."""
        return slice(self.modes.start, self.terms.stop)

    @cached_property
    def imperfections(self) -> slice:
        """Coefficients of physical imperfections: those for the modes and those for the traces."""
        return slice(self.modes.start, self.traces.stop)

    @cached_property
    def film(self) -> slice:
        """All unknowns of the film: its parameters and its coefficients."""
        return slice(self.parameters.start, self.terms.stop)

    @property
    def parameter_count(self) -> int:
        """Number of parameters of the film."""
        return _count(self.parameters)

    @property
    def coefficient_count(self) -> int:
        """Number of coefficients of the film."""
        return _count(self.coefficients)

    @property
    def film_count(self) -> int:
        """Number of parameters and coefficients of the film together."""
        return _count(self.film)

    @property
    def count(self) -> int:
        """Number of all unknowns."""
        return self.film_count + _count(self.nuisances)

    def parameter(self, name: str) -> int:
        """Return the index of a parameter in the vector of unknowns."""
        return self.parameter_names.index(name)

    def nuisance(self, name: str) -> int:
        """Return the index of a nuisance in the vector of unknowns."""
        names = [nuisance.name for nuisance in NUISANCES]
        return self.film_count + names.index(name)


def _count(unknowns: slice) -> int:
    """Return the number of unknowns in a slice."""
    return int(unknowns.stop - unknowns.start)


def _after(previous: slice, count: int) -> slice:
    """Return the slice of `count` unknowns that begins where another slice ends."""
    return slice(previous.stop, previous.stop + count)
