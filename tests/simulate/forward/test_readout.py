"""Conversion of stress into charge: area and edge readout, polygons, pressure and temperature."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SensorError
from isocharge.simulate import (
    Calibration,
    Circle,
    Electrode,
    Equilibrium,
    Polygon,
    Probe,
    Sensor,
    load_sensor,
    press,
    touch_charge,
    touch_stress,
)
from isocharge.simulate.forward.readout import (
    MAP_COUNTS,
    NEAR_DISTANCE,
    ElectrodePieces,
    contact_charges,
    piece_charge_per_stress,
    stress_charge,
    thermal_charge,
)
from isocharge.simulate.mechanics.warming import tension_change
from isocharge.simulate.numerics.polygon import to_corners
from solved_charges import with_film, with_piezo

PROBE = Circle(1.0)
UNIAXIAL = load_sensor("four-25um-uniaxial")
AREA = 9.0
D31 = 20.0
D32 = 2.0
SQUARE = Electrode.of_square("A", (10.0, 0.0), 3.0)
TRIANGLE = Electrode("T", ((-12.0, 4.0), (-8.0, 4.0), (-10.0, 8.0)))


def charge_of(sensor: Sensor, stress, per_side: int = 12) -> np.ndarray:
    """Charges under a made-up stress field, a function of x and y that returns (s11, s22, s12)."""
    pieces = ElectrodePieces.of(sensor)
    charge_per_stress = piece_charge_per_stress(sensor)
    charge = np.zeros(len(sensor.electrodes))
    for rule in pieces.rules(PROBE, np.zeros(1), (per_side, per_side)):
        values = np.stack(np.broadcast_arrays(*stress(rule.points.real, rule.points.imag)))
        pair_charge = np.einsum("ckp,kp,kc->k", values, rule.area, charge_per_stress[pieces.kind[rule.piece]])
        np.add.at(charge, pieces.electrode[rule.piece], pair_charge)
    return sensor.gains * charge


def contact_charge(sensor: Sensor, probe: Probe, at: tuple[float, float], force: float) -> np.ndarray:
    """Charges of the contact pressure under one press."""
    (charge,) = contact_charges(sensor, probe, np.array([[*at, force]]))
    return charge


@pytest.mark.parametrize("readout", ["area", "edge"])
@pytest.mark.parametrize("per_side", [1, 3, 12])
def test_linear_stress_is_read_at_the_centre(readout, per_side):
    """The mean of a linear function over a square or two opposite edges is its value at the centre."""
    sensor = replace(UNIAXIAL, readout=readout)
    charge = charge_of(sensor, lambda x, y: (1.0 + 3.0 * x - 2.0 * y, -4.0 * x + y, x), per_side)
    x, y = np.array([electrode.centre for electrode in sensor.electrodes]).T
    expected = AREA * (D31 * (1.0 + 3.0 * x - 2.0 * y) + D32 * (-4.0 * x + y))
    np.testing.assert_allclose(charge, expected, rtol=1e-12, atol=1e-9)


def test_edge_readout_equals_equation_3_of_the_paper():
    """Quadratic stresses distinguish the edges: s11 on the left and right, s22 on the lower and upper edges (eq. 3)."""
    square = Electrode.of_square("A", (5.0, -2.0), 3.0)
    sensor = replace(UNIAXIAL, electrodes=(square,), readout="edge")
    h2 = 1.5**2

    def over_x(x, _):
        return (x - 5.0) ** 2, (x - 5.0) ** 2, 0 * x

    def over_y(_, y):
        return (y + 2.0) ** 2, (y + 2.0) ** 2, 0 * y

    np.testing.assert_allclose(charge_of(sensor, over_x), AREA * (D31 * h2 + D32 * h2 / 3), rtol=1e-12)
    np.testing.assert_allclose(charge_of(sensor, over_y), AREA * (D31 * h2 / 3 + D32 * h2), rtol=1e-12)


def test_edges_of_a_turned_pattern_are_those_of_the_same_squares(solved):
    """The pattern of four squares has the same squares after a quarter turn, with other names."""
    sensor = replace(UNIAXIAL, readout="edge")
    turned = replace(sensor, calibration=Calibration(rotation=0.5 * np.pi))
    np.testing.assert_allclose(sorted(touch_charge(turned, solved)), sorted(touch_charge(sensor, solved)), rtol=1e-9)


@pytest.fixture(scope="module")
def solved(film) -> Equilibrium:
    return press(film, PROBE, (4.0, 3.0), 1.0)


# Traces, concave electrodes, and metal on the back


@pytest.mark.parametrize("at", [(10.5, 2.0), (14.0, 0.2)])  # beside the square, on the trace
def test_a_trace_collects_the_stress_under_it(film, at):
    """The charge of a square with a bent trace equals the sum of the charges of its three rectangles."""
    traced = SQUARE.with_trace(((10.0, 0.0), (18.0, 0.0), (18.0, 20.0)), 0.5)
    across = Electrode("B", ((11.5, -0.25), (18.25, -0.25), (18.25, 0.25), (11.5, 0.25)))
    along = Electrode("C", ((17.75, 0.25), (18.25, 0.25), (18.25, 20.0), (17.75, 20.0)))
    solved = press(film, PROBE, at, 1.0)
    charge, charges = (
        touch_charge(replace(UNIAXIAL, electrodes=electrodes), solved)
        for electrodes in ((traced,), (SQUARE, across, along))
    )
    assert charge[0] == pytest.approx(charges.sum(), rel=1e-4)


def test_pressure_and_thermal_charge_only_where_front_and_back_overlap():
    """The back metal covers the square only, so the trace collects no charge."""
    traced = replace(SQUARE.with_trace(((10.0, 0.0), (20.0, 0.0)), 0.5), back=(SQUARE.corners,))
    for charge in (
        lambda sensor: charge_of(sensor, lambda x, y: (x**2, y, 0 * x)),
        lambda sensor: contact_charge(sensor, PROBE, (11.5, 0.0), 1.0),
        lambda sensor: thermal_charge(with_piezo(sensor, pyro=-30.0), 0.1),
    ):
        there, alone = (charge(replace(PRESSED, electrodes=(electrode,))) for electrode in (traced, SQUARE))
        np.testing.assert_allclose(there, alone, rtol=1e-12)


@pytest.mark.parametrize("readout", ["area", "edge"])
def test_each_rule_is_accurate_from_its_smallest_distance_on(film, readout):
    """The electrode lies at the smallest distance at which the forward map uses the rule."""
    sensor = replace(UNIAXIAL, electrodes=(SQUARE,), readout=readout)
    reach = 1.0
    unit = 1.5 * np.sqrt(2.0) + reach
    for smallest_distance, tolerance in ((0.0, 2e-4), (NEAR_DISTANCE, 1e-4)):
        pressed = press(film, Circle(reach), (10.0 - smallest_distance * unit, 0.4), 1.0)
        np.testing.assert_allclose(
            stress_charge(sensor, pressed, MAP_COUNTS), stress_charge(sensor, pressed, (40, 40)), rtol=tolerance
        )


@pytest.mark.parametrize("probe", [Circle(0.1), Polygon.rectangle(4.0, 0.5, 0.3)], ids=str)
def test_small_probe_on_a_large_electrode(film, probe):
    """The charge of a square of 12 mm equals the sum over squares of 0.5 mm, for presses and for forward maps."""
    centres = 0.5 * np.arange(-11.5, 12.0)
    cells = [Electrode.of_square("A", (x, y), 0.5) for x in centres for y in centres]
    pressed = press(film, probe, (2.3, -1.1), 0.5)
    points = ElectrodePieces.covering(cells)
    large = replace(UNIAXIAL, electrodes=(Electrode.of_square("A", (0.0, 0.0), 12.0),))
    expected = 0.0
    for rule in points.rules(Circle(100.0), np.zeros(1), (12, 12)):
        stress = touch_stress(pressed, to_corners(rule.points.ravel())).reshape(*rule.points.shape, 3)
        expected += float((rule.area[..., None] * stress * [D31, D32, 0.0]).sum())
    assert touch_charge(large, pressed)[0] == pytest.approx(expected, rel=5e-5)
    assert stress_charge(large, pressed, MAP_COUNTS)[0] == pytest.approx(expected, rel=2e-4)


def test_touch_charge_with_another_film_raises_error(solved):
    other = with_film(solved, young=2500.0)
    with pytest.raises(SensorError, match=r"another film: expected Film\(.*young=3000.*got .*young=2500"):
        touch_charge(load_sensor("three-25um-biaxial"), other)


# Contact pressure, d33


PRESSED = with_piezo(UNIAXIAL, d33=-30.0)


@pytest.mark.parametrize(
    ("probe", "at", "covered"),
    [
        (Circle(5.0), (10.0, 0.0), 9.0),  # the whole electrode under it
        (PROBE, (8.5, 1.5), 0.25 * np.pi),  # about a corner
        (Polygon.triangle(1.0), (10.0, 1.5), 5 / 9 * np.sqrt(3.0) / 4),  # all below the centroid
    ],
)
def test_contact_charge_is_proportional_to_the_covered_area(probe, at, covered):
    """The charge is Q = -d33 F / (2 footprint) * overlap. It is positive for the negative d33 of PVDF.

    The stress s33(z) = -p (1/2 + z / h) balances the pressure p on one face of the film, and the other face is free.
    Its mean is -p / 2.
    """
    charge = contact_charge(PRESSED, probe, at, 0.7)
    np.testing.assert_allclose(charge, [0.5 * 30.0 * 0.7 / probe.area * covered, 0.0, 0.0, 0.0], rtol=1e-9, atol=1e-12)


def test_contact_charge_follows_gain_and_place_of_the_electrodes():
    """The layout is shifted to the probe, and the gain is two."""
    calibration = Calibration(gain={"A": 2.0}, shift=(2.0, 0.0))
    still = contact_charge(PRESSED, PROBE, (8.5, 0.2), 1.0)
    moved = contact_charge(replace(PRESSED, calibration=calibration), PROBE, (10.5, 0.2), 1.0)
    np.testing.assert_allclose(moved, [2.0 * still[0], 0.0, 0.0, 0.0], rtol=1e-9, atol=1e-12)


# Charges without a touch


def test_contact_charges_of_many_presses_are_those_of_each_press():
    """The presses lie at the edges of two electrodes, of which one has a positive y, and on the film alone."""
    sensor = replace(PRESSED, electrodes=PRESSED.electrodes[:2])
    places = [(8.5, 1.5), (8.5, -1.7), (1.0, 8.0), (-1.3, -8.0), (4.0, 3.0)]
    contact = np.column_stack([places, [0.3, 0.5, 0.7, 0.9, 1.1]])
    orientation = np.linspace(0.0, 1.0, len(contact))
    probe = Polygon.triangle(1.0)
    expected = [
        contact_charge(sensor, probe.rotated(angle), (x, y), force)
        for (x, y, force), angle in zip(contact.tolist(), orientation.tolist(), strict=True)
    ]
    np.testing.assert_allclose(contact_charges(sensor, probe, contact, orientation), expected)


@pytest.mark.parametrize(("readout", "d12"), [("area", 5.0), ("edge", 0.0)])
def test_thermal_charge_of_a_clamped_film_contains_the_charge_of_its_changed_tension(readout, d12):
    """The pyroelectric charge of a free film is -15 pC/mm^2. The square T has 4 mm^2 and a gain of 0.5.

    The edge readout ignores d12.
    """
    electrodes = (SQUARE, Electrode.of_square("T", (-10.0, 4.0), 2.0))
    sensor = replace(with_piezo(UNIAXIAL, pyro=-30.0, d12=5.0), electrodes=electrodes, readout=readout)
    clamped = with_film(replace(sensor, calibration=Calibration(gain={"T": 0.5})), expansion=(1e-4, -1e-5), axis=0.4)
    density = -15.0 + [D31, D32, 2.0 * d12] @ tension_change(clamped.film, 0.5, 0.0)
    np.testing.assert_allclose(thermal_charge(clamped, 0.5), [9.0 * density, 2.0 * density], rtol=1e-12)
