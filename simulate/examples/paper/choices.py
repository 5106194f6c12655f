"""What the paper says in numbers, and what it leaves open and we choose."""

from dataclasses import dataclass, replace

import numpy as np

from isocharge.simulate import Circle, Electrode, Polygon, Probe, Sensor, load_sensor
from isocharge.simulate.forward.charge_spline import MAX_KNOT_SPACING
from isocharge.simulate.sensor.sensor import Readout

# What the paper says

CUBICS = ((126.3, -592.4, 1743.9, 183.0), (52.679, -247.820, 731.498, 90.838), (47.189, -222.109, 656.633, 84.974))
"""Eq. 4: charge (pC) of A, B, C against force (N), falling powers."""

ERROR_MM = 0.122
"""Distance between press and triangulated position ("only 0.122 mm")."""

CONTOUR_PC = 650.0
"""The example of a contour, Fig. 6, pC."""

ELEMENTS = (13_000, 14_000)
"""Triangles of a mesh, least and most."""

LINEAR_N = 0.5
LINEAR_MPA = 40.0
"""Force up to which charge is called linear, and stress up to which PVDF is."""

FIG_8_DEG = (140.0, 240.0)
"""Angles of the uppermost and the lowermost curve of Fig. 8."""

# What it leaves open

TRIANGLE = Polygon.triangle(4.0)
RECTANGLE = Polygon.rectangle(4.0, 2.0)
CIRCLE = Circle(1.0)

OTHERS = (Polygon.triangle(2.0), Polygon.triangle(6.0), CIRCLE, RECTANGLE)
"""Probes to show what the size and the shape change."""


@dataclass(frozen=True)
class Choices:
    """What the paper does not give.

    Attributes:
        triangle: Fig. 5, 6, 9, 10, 12 and eq. 4: "the triangular probe"; its shape is given.
        rectangle: Fig. 8; its shape is given.
        circle: Fig. 11; the paper gives its radius, too.
        readout: The paper's eq. 3.
        degree: Of the polynomial along a line.
        length: Of the lines of a mapping scheme, mm.
        printed_length: Of lines where B sits at 60 degrees, mm: some of them lead away from the centre.
        spacing: Of the knots that charges are tabled with, mm.
        radius: Of the working area, mm.
        presses: How many presses of the working area a distribution is made from.
        thickness: Of the films that are compared, mm.
        pretension: Of them, MPa.
        force: At which they are solved, N.
        shown: A press to show a triangulation with, mm.
        probes: Other probes, to show what their size changes.
        young: Moduli, MPa, to show what they change; and Poisson's ratios.
        poisson: See `young`.
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
        """A built-in sensor, "three" or "four", with the paper's readout or another."""
        return replace(load_sensor(f"{layout}-25um-{film}"), readout=readout or self.readout)

    def as_printed(self) -> Sensor:
        """Three electrodes with B and C at 60 and 120 degrees from x, as the paper's sentence has it, A at -y."""
        places = [10.0 * np.exp(1j * np.deg2rad(angle)) for angle in (-90.0, 60.0, 120.0)]
        squares = [Electrode.of_square(name, (z.real, z.imag), 3.0) for name, z in zip("ABC", places, strict=True)]
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
"""Fewer presses and films, shorter lines: every figure and number, most of them coarser."""
