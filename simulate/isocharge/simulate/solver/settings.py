"""How presses are solved: accuracy, theory and mesh."""

from dataclasses import dataclass
from typing import Literal

from isocharge.simulate.mechanics.theory import ACCURACY, Theory
from isocharge.simulate.mesh.resolution import Resolution

TOLERANCE = 1e-7
"""Out-of-balance force over load, dimensionless: far below the error of the mesh, well above round-off."""

Auto = Literal["auto"]
"""Choose it to suit the press, or all presses of a forward map."""


@dataclass(frozen=True)
class SolveSettings:
    """How the film is solved.

    Attributes:
        accuracy: Target for the relative error of a charge.
        theory: Which terms to model; "auto" for the fewest that the accuracy allows.
        resolution: Mesh of the template; "auto" for the coarsest that reaches the accuracy.
        layer: Width of the thin rings at the rim over the film's radius; "auto" for six bending lengths, or for the
            width of the equilibrium that the solve starts from if that is near.
        tolerance: Out-of-balance force over load at which a solve has converged.
    """

    accuracy: float = ACCURACY
    theory: Theory | Auto = "auto"
    resolution: Resolution | Auto = "auto"
    layer: float | Auto = "auto"
    tolerance: float = TOLERANCE
