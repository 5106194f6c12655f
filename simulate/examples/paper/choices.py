"""Numbers that the paper states, and our choices for values that the paper does not state."""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.simulate import Circle, Electrode, Polygon, Probe, Sensor, load_sensor
from isocharge.simulate.forward.charge_spline import MAX_KNOT_SPACING
from isocharge.simulate.sensor.sensor import Readout

# Numbers that the paper states

CUBICS = ((126.3, -592.4, 1743.9, 183.0), (52.679, -247.820, 731.498, 90.838), (47.189, -222.109, 656.633, 84.974))
"""Eq. 4: coefficients of the charges (pC) of A, B and C as cubic polynomials of the force (N), highest power first."""

ERROR_MM = 0.122
"""Distance between the press and the triangulated position ("only 0.122 mm")."""

CONTOUR_PC = 650.0
"""Charge of the contour that Fig. 6 shows as an example, pC."""

ELEMENTS = (13_000, 14_000)
"""Smallest and largest number of triangles of a mesh."""

LINEAR_N = 0.5
LINEAR_MPA = 40.0
"""Force up to which the paper calls the charge linear, and stress up to which it calls PVDF linear."""

FIG_8_DEG = (140.0, 240.0)
"""Angles of the uppermost and the lowermost curve of Fig. 8."""

# Values that the paper does not state

TRIANGLE = Polygon.triangle(4.0)
RECTANGLE = Polygon.rectangle(4.0, 2.0)
CIRCLE = Circle(1.0)

OTHERS = (Polygon.triangle(2.0), Polygon.triangle(6.0), CIRCLE, RECTANGLE)
"""Further probes, which show the influence of the size and the shape."""


@dataclass(frozen=True)
class Choices:
    """Our choices for values that the paper does not state.

    Attributes:
        triangle: Probe of Fig. 5, 6, 9, 10, 12 and eq. 4, "the triangular probe". The paper states its shape only.
        rectangle: Probe of Fig. 8. The paper states its shape only.
        circle: Probe of Fig. 11. The paper also states its radius.
        readout: Readout of the electrodes, which is eq. 3 of the paper.
        degree: Degree of the polynomial along a line.
        length: Length of the lines of a mapping scheme, mm.
        printed_length: Length of the lines if B lies at 60 degrees, mm. Some of these lines lead away from the centre.
        spacing: Distance between the knots of the charge splines, mm.
        radius: Radius of the working area, mm.
        presses: Number of presses in the working area for the distribution of the errors.
        thickness: Thicknesses of the films that are compared, mm.
        pretension: Pretensions of the films that are compared, MPa.
        force: Forces at which these films are solved, N.
        shown: Position of the press whose triangulation is shown, mm.
        probes: Further probes, which show the influence of the size and the shape.
        young: Further Young's moduli, which show the influence of the modulus, MPa.
        poisson: Further Poisson's ratios, which show the influence of the ratio.
    """

    triangle: Probe = TRIANGLE
    rectangle: Probe = RECTANGLE
    circle: Probe = CIRCLE
    readout: Readout = "edge"
    degree: int = 4
    length: float = 20.0
    printed_length: float = 12.0
    spacing: float = MAX_KNOT_SPACING
    radius: float = 8.0
    presses: int = 300
    thickness: tuple[float, ...] = (0.025, 0.05, 0.11, 0.2, 0.35, 0.6, 1.0)
    pretension: tuple[float, ...] = (0.0, 0.5, 1.0, 1.5, 2.5, 5.0)
    force: tuple[float, ...] = (0.05, 0.1, 0.175, 0.25, 0.35, 0.5, 0.8, 1.3, 2.0)
    shown: tuple[float, float] = (2.0, 3.0)
    probes: tuple[Probe, ...] = OTHERS
    young: tuple[float, ...] = (2000.0, 4000.0)
    poisson: tuple[float, ...] = (0.25, 0.45)

    def sensor(self, layout: str, film: str = "biaxial", readout: Readout | None = None) -> Sensor:
        """Return a built-in sensor with the readout of the paper, or with another readout.

        Args:
            layout: "three" or "four" electrodes.
            film: "biaxial" or "uniaxial".
            readout: The other readout; None for the readout of the paper.
        """
        return replace(load_sensor(f"{layout}-25um-{film}"), readout=readout or self.readout)

    def as_printed(self) -> Sensor:
        """Return the sensor as the text of the paper describes it, with B and C at 60 and 120 degrees from x."""
        centres = [10.0 * np.exp(1j * np.deg2rad(angle)) for angle in (-90.0, 60.0, 120.0)]
        squares = [Electrode.of_square(name, (z.real, z.imag), 3.0) for name, z in zip("ABC", centres, strict=True)]
        return replace(self.sensor("three"), name="B and C at 60 and 120 degrees", electrodes=tuple(squares))


QUICK = Choices(
    degree=3,
    length=16.0,
    printed_length=8.0,
    spacing=0.6,
    presses=30,
    thickness=(0.025, 1.0),
    pretension=(0.0, 1.5),
    force=(0.05, 0.25, 0.5, 1.0, 2.0),
    probes=OTHERS[:1],
    young=(2000.0,),
    poisson=(0.25,),
)
"""Choices with fewer presses and films and shorter lines. All figures and numbers are computed, with less accuracy."""
