"""Order of the linear unknowns of a film in the vector that `film_filter` estimates."""

from dataclasses import dataclass


@dataclass(frozen=True)
class UnknownsLayout:
    """Positions of the linear unknowns in a vector.

    Attributes:
        electrodes: Number of electrodes.
        direction_count: Number of directions in which the film is uncertain.
    """

    electrodes: int
    direction_count: int

    @property
    def gains(self) -> slice:
        """Deviations of the gains from one, in units of GAIN_STD, one for each electrode."""
        return slice(0, self.electrodes)

    @property
    def offset(self) -> int:
        """Mean of the common offset, pC."""
        return self.electrodes

    @property
    def directions(self) -> slice:
        """Coordinates along the directions in which the film is uncertain, in standard deviations."""
        return slice(self.electrodes + 1, self.size)

    @property
    def size(self) -> int:
        """Number of linear unknowns."""
        return self.electrodes + 1 + self.direction_count
