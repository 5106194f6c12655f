"""How presses are solved: accuracy, theory and mesh."""

from dataclasses import dataclass

from isocharge.simulate.mechanics.theory import ACCURACY, Theory
from isocharge.simulate.mesh.resolution import Resolution

TOLERANCE = 1e-7
"""Out-of-balance force over load, dimensionless: far below the error of the mesh, well above round-off."""


@dataclass(frozen=True)
class SolveSettings:
    """How the film is solved. What is None is chosen to suit the press, or all presses of a forward map.

    Attributes:
        accuracy: Target for the relative error of a charge.
        theory: Which terms to model; None for the fewest that the accuracy allows.
        resolution: Mesh of the template; None for the coarsest that reaches the accuracy.
        layer: Width of the thin rings at the rim over the film's radius; None for six bending lengths, or for the width
            of the equilibrium that the solve starts from if that is near.
        tolerance: Out-of-balance force over load at which a solve has converged.
    """

    accuracy: float = ACCURACY
    theory: Theory | None = None
    resolution: Resolution | None = None
    layer: float | None = None
    tolerance: float = TOLERANCE
