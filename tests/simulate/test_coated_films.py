"""Films with a coating of metal or ink, compared with a closed form and with scikit-fem, and error messages."""

from dataclasses import replace

import numpy as np
import pytest

from isocharge.common.errors import SceneError, SensorError
from isocharge.simulate import Circle, ForwardMap, Resolution, load_sensor, press, touch_charge
from isocharge.simulate.mechanics.energy import ElasticFilm
from isocharge.simulate.mechanics.scaling import DimensionlessGroups
from isocharge.simulate.numerics.interpolation import gauss_reference_square, tensor_values
from isocharge.simulate.sensor.film import Coat
from isocharge.simulate.solver.assembly import assembly
from isocharge.simulate.solver.load_case import place_coated

SENSOR = load_sensor("four-25um-biaxial")
TAUT = replace(SENSOR, film=replace(SENSOR.film, pretension=1.0))
INK = replace(TAUT, coating=0.3 * TAUT.film.young * TAUT.film.thickness)
PROBE = Circle(1.0)
AT = (3.0, -2.0)
FORCE = 0.5


@pytest.mark.slow
def test_charges_of_stiffer_electrodes_agree_with_another_code():
    """The reference was computed with scikit-fem 12 by `film_skfem.py` of commit 640aecf.

    It is extrapolated from triangles with edges of 0.6 and 0.3 mm to a fine mesh.
    """
    coated, uncoated = (touch_charge(s, press(s.coated_film, PROBE, AT, FORCE)) for s in (INK, TAUT))
    np.testing.assert_allclose(coated / uncoated, [0.831745, 0.830992, 0.830707, 0.832853], rtol=1.5e-3)


@pytest.mark.parametrize("stiffening", [0.3, 3.0])
def test_strain_of_a_film_with_a_round_coat_is_the_closed_form(stiffening):
    """The strain under a round coat is Lame's solution for a radial load in the plane of the film.

    For the pressure 1 - r^2, the displacement is u = r^3 / (4 K) + A r + B / r. The stiffness K and the constants have
    different values inside and outside the coat, and u and the radial stress are continuous at its edge.
    """
    film = SENSOR.film
    b = 6.0 / 45.0
    nu = SENSOR.film.poisson
    corner = 6.0 * np.exp(2j * np.pi * np.arange(96) / 96)
    disk = tuple(zip(corner.real.tolist(), corner.imag.tolist(), strict=True))
    film = replace(film, coat=Coat(stiffening * film.young * film.thickness, ((disk,),)))
    mesh = place_coated(film, PROBE, (0.0, 0.0), Resolution(4, 8, 4, 0), 0.02)
    geometry = mesh.geometry
    xi, eta, _ = gauss_reference_square(5)
    pressure = geometry.weights * (1.0 - np.abs(mesh.points @ tensor_values(4, xi, eta).T) ** 2)
    force = np.einsum("ep,epan->ena", pressure, geometry.gradient)
    pressed = np.stack([*(geometry.gather(force[..., axis]) for axis in (0, 1)), 0.0 * geometry.load], axis=1)
    flat = DimensionlessGroups(squared_amplitude=1e-12, load=1.0, tension=1.0, bending=0.0, poisson=nu)
    tangent = ElasticFilm(geometry, flat).tangent(np.zeros_like(pressed))
    field = -assembly(mesh.template, 3).factor(tangent).solve(pressed)
    outer = 1.0 / (1.0 - nu**2)
    inner = (1.0 + stiffening) * outer
    system = [[0.0, 1.0, 1.0], [b, -b, -1.0 / b], [inner * (1.0 + nu), -outer * (1.0 + nu), outer * (1.0 - nu) / b**2]]
    c, _, _ = np.linalg.solve(system, [-0.25 / outer, b**3 * (0.25 / outer - 0.25 / inner), 0.0])
    at = np.array([0.0, 0.5 * b])
    element, xi, eta, _ = mesh.locate(at + 0j)
    slope = mesh.gradient(element, xi, eta) @ field[mesh.template.nodes[element]]
    mixed = np.stack([slope[:, 0, 0], slope[:, 1, 1], slope[:, 0, 1] + slope[:, 1, 0]], axis=1)
    expected = np.stack([c + 0.75 * at**2 / inner, c + 0.25 * at**2 / inner], axis=1)
    np.testing.assert_allclose(mesh.coat.film_strain(at + 0j, mixed)[:, :2], expected, rtol=3e-3 * stiffening)


def test_coats_on_both_sides_are_equivalent_to_one_coat_with_their_total_stiffness():
    both = tuple(replace(e, square=False, back=(e.corners,)) for e in INK.electrodes)
    two = replace(INK, electrodes=both, coating=0.5 * INK.coating)
    points = (7.3 + 0.1 * np.arange(30) + 0.7j) / INK.film.radius  # across an edge
    added = []
    for film in (two.coated_film, INK.coated_film):
        mesh = place_coated(film, PROBE, (0.0, 0.0), Resolution(2, 8, 2, 0), 0.02)
        added.append(mesh.coat.moduli(points))
    np.testing.assert_allclose(*added, atol=1e-9)
    nu = INK.film.poisson
    np.testing.assert_allclose(
        added[0][[0, -1]],
        np.multiply.outer([0.0, 0.3], np.array([[1, nu, 0], [nu, 1, 0], [0, 0, 0.5 - 0.5 * nu]]) / (1 - nu**2)),
        atol=1e-9,
    )


def test_pressed_film_and_read_film_must_be_equal():
    with pytest.raises(SensorError, match=r"another film: expected .*Coat"):
        touch_charge(INK, press(INK.film, PROBE, AT, FORCE))
    with pytest.raises(SceneError, match=r"axisymmetric film, got .*coat"):
        ForwardMap.build(INK, PROBE)
