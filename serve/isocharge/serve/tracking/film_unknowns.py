"""Order of the linear unknowns of a film in the vector that `film_filter` estimates."""

from dataclasses import dataclass


@dataclass(frozen=True)
class UnknownsLayout:
    """Indices of the linear unknowns in the vector of all linear unknowns.

    The vector contains the gains, the offset and the directions, in this order.

    Attributes:
        electrodes: Number of electrodes.
        direction_count: Number of directions in which the film is uncertain.
    """

    electrodes: int
    direction_count: int

    @property
    def gains(self) -> slice:
        """Slice of the gains. Each gain is stored as its deviation from 1, in units of `GAIN_STD`."""
        return slice(0, self.electrodes)

    @property
    def offset(self) -> int:
        """Index of the mean of the common offset, pC."""
        return self.electrodes

    @property
    def directions(self) -> slice:
        """Slice of the coordinates along the directions in which the film is uncertain, in standard deviations."""
        return slice(self.electrodes + 1, self.size)

    @property
    def size(self) -> int:
        """Number of linear unknowns."""
        return self.electrodes + 1 + self.direction_count
