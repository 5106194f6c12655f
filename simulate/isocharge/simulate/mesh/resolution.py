"""How fine a mesh is."""

from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Resolution:
    """How fine the mesh is.

    Attributes:
        order: Polynomial order of the elements.
        around: Elements round the circle; a polygon of n corners takes the nearest multiple of 2 n.
        rings: Rings between the circle and the rim, in equal steps of the logarithm.
        rim: Thin rings at the rim, for bending's boundary layer.
    """

    order: int = 4
    around: int = 8
    rings: int = 5
    rim: int = 0

    @property
    def description(self) -> str:
        """The four numbers as a dataset's manifest names them: "order 4, around 8, rings 5, rim 0"."""
        return ", ".join(f"{name} {value}" for name, value in asdict(self).items())

    def __post_init__(self) -> None:
        if self.order < 2 or self.around < 4 or self.rings < 1 or self.rim < 0:
            raise ValueError(
                f"expected order >= 2, around >= 4, rings >= 1 and rim >= 0, got {self.order}, {self.around}, "
                f"{self.rings}, {self.rim}"
            )
