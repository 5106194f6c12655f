"""How presses are solved: accuracy, theory and mesh."""

from dataclasses import dataclass

from isocharge.simulate.mechanics.theory import ACCURACY, Theory
from isocharge.simulate.mesh.resolution import Resolution


@dataclass(frozen=True)
class SolveSettings:
    """How the film is solved in a sweep; what is absent is chosen by the scene, see `ForwardMap.build`.

    Attributes:
        accuracy: Relative error of a charge that is wanted.
        theory: Which terms to model.
        resolution: Mesh.
    """

    accuracy: float = ACCURACY
    theory: Theory | None = None
    resolution: Resolution | None = None
