"""The first rungs of the ladder: energy, residual and tangent agree; rigid motions cost nothing; the patch test.

The energy is a polynomial of degree four in the nodal values, so five-point differences are exact but for round-off.
"""

import numpy as np
import pytest
from scipy.integrate import dblquad
from scipy.spatial.transform import Rotation

from isocharge.simulate import Resolution
from isocharge.simulate.membrane import Geometry, Groups, Membrane, strain, stress
from isocharge.simulate.template import Placement, Template, template

GROUPS = (
    Groups(amplitude2=0.0, load=1.0, tension=0.0, poisson=0.34),
    Groups(amplitude2=0.02, load=1.0, tension=0.3, poisson=0.34),
    Groups(amplitude2=0.7, load=2.0, tension=0.0, poisson=0.0),
)
STENCIL = ((-2, 1 / 12), (-1, -8 / 12), (1, 8 / 12), (2, -1 / 12))


@pytest.fixture(params=GROUPS, ids=lambda g: f"A2={g.amplitude2:g},tension={g.tension:g}")
def membrane(request, coarse, off_centre) -> Membrane:
    return Membrane(Geometry.build(coarse, off_centre), request.param)


@pytest.fixture(scope="module")
def points(coarse, off_centre) -> np.ndarray:
    """Film coordinates (X1, X2) of the nodes."""
    z = off_centre.to_film(coarse.node_points(off_centre.rho))
    return np.stack([z.real, z.imag], axis=1)


# Rung 1: finite differences


@pytest.mark.parametrize("seed", range(3))
def test_residual_is_the_slope_of_the_energy(membrane, coarse, random_field, seed):
    field, direction = random_field(coarse, seed), random_field(coarse, seed + 100)
    slope = sum(share * membrane.energy(field + step * direction) for step, share in STENCIL)
    assert np.sum(membrane.residual(field) * direction) == pytest.approx(slope, rel=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_tangent_is_the_slope_of_the_residual(membrane, coarse, random_field, seed):
    field, direction = random_field(coarse, seed), random_field(coarse, seed + 100)
    slope = sum(share * membrane.residual(field + step * direction) for step, share in STENCIL)
    nodal = np.einsum("eminj,enj->emi", membrane.tangent(field), direction[coarse.nodes])
    product = np.zeros_like(field)
    np.add.at(product, coarse.nodes, nodal)
    np.testing.assert_allclose(product, slope, atol=1e-10 * np.abs(slope).max())


def test_tangent_is_symmetric(membrane, coarse, random_field):
    tangent = membrane.tangent(random_field(coarse, 5))
    np.testing.assert_allclose(tangent, tangent.transpose(0, 3, 4, 1, 2), atol=1e-12 * np.abs(tangent).max())


# Strain, stress and energy against formulas written down a second time


def physical(slope: np.ndarray, amplitude2: float) -> np.ndarray:
    """F = dx/dX, shape (3, 2), of the scaled gradient d(U1, U2, W)/d(X1, X2), shape (2, 3)."""
    scale = np.array([amplitude2, amplitude2, np.sqrt(amplitude2)])
    return np.eye(3, 2) + (slope * scale).T


@pytest.mark.parametrize("seed", range(5))
def test_strain_is_green_lagranges(seed):
    slope, amplitude2 = np.random.default_rng(seed).standard_normal((2, 3)), 0.3
    f = physical(slope, amplitude2)
    green = 0.5 * (f.T @ f - np.eye(2)) / amplitude2
    np.testing.assert_allclose(strain(slope, amplitude2), [green[0, 0], green[1, 1], 2.0 * green[0, 1]], atol=1e-13)


@pytest.mark.parametrize("poisson", [0.0, 0.34, 0.49])
def test_stress_solves_the_plane_stress_compliance(poisson):
    """Hooke's law the other way round: strain from stress with unit modulus."""
    e11, e22, shear = 0.3, -0.2, 0.5
    s11, s22, s12 = stress(np.array([e11, e22, shear]), poisson)
    np.testing.assert_allclose([s11 - poisson * s22, s22 - poisson * s11, 2 * (1 + poisson) * s12], [e11, e22, shear])


def test_energy_of_a_smooth_field_is_scipys_integral():
    """A quadratic field over the whole film, the energy integrated by scipy in polar coordinates."""
    groups, mesh, place = Groups(0.2, 0.0, 0.4, 0.34), template(Resolution(8, 8, 4)), Placement.of_circle(0.3, 0.2)
    z = place.to_film(mesh.node_points(place.rho))
    x, y = z.real, z.imag
    field = np.stack([0.3 * x * y, 0.1 * y**2 - 0.2 * x, 0.5 * x**2 - 0.3 * x * y + 0.2 * y], axis=1)

    def density(r: float, t: float) -> float:
        x, y = r * np.cos(t), r * np.sin(t)
        slope = np.array([[0.3 * y, -0.2, x - 0.3 * y], [0.3 * x, 0.2 * y, 0.2 - 0.3 * x]])
        f = physical(slope, groups.amplitude2)
        e = 0.5 * (f.T @ f - np.eye(2)) / groups.amplitude2
        nu, trace = groups.poisson, np.trace(e)
        return r * (0.5 / (1 - nu**2) * ((1 - nu) * np.sum(e * e) + nu * trace**2) + groups.tension * trace)

    expected, _ = dblquad(density, 0.0, 2.0 * np.pi, 0.0, 1.0, epsabs=1e-10)
    assert Membrane(Geometry.build(mesh, place), groups).energy(field) == pytest.approx(expected, rel=1e-8)


# The load


@pytest.mark.parametrize(("distance", "radius"), [(0.0, 0.02), (0.4, 0.11), (0.1, 0.6)])
def test_load_is_uniform_over_the_footprint(distance, radius):
    """Its moments are a uniform disk's: 1, the centre, R^2/4 about the centre along each axis, none mixed."""
    mesh, place = template(Resolution(8, 8, 4)), Placement.of_circle(distance, radius)
    load = Geometry.build(mesh, place).load
    about = place.to_film(mesh.node_points(place.rho)) - distance
    assert load.sum() == pytest.approx(1.0, rel=1e-13)
    assert abs(load @ about) < 1e-8 * radius
    assert load @ about.real**2 == pytest.approx(0.25 * radius**2, rel=1e-7)
    assert load @ about.imag**2 == pytest.approx(0.25 * radius**2, rel=1e-7)
    assert abs(load @ (about.real * about.imag)) < 1e-8 * radius**2
    assert not load[~np.isin(np.arange(mesh.n_node), mesh.nodes[mesh.footprint])].any()


def test_forces_balance(membrane, coarse, random_field):
    """A translation does no work but against the load: the sum of all nodal forces is the load, upwards."""
    total = membrane.residual(random_field(coarse, 2)).sum(axis=0)
    np.testing.assert_allclose(total, [0.0, 0.0, -membrane.groups.load], atol=1e-11)


# Rung 2: rigid motions


def moved(points: np.ndarray, rotation: np.ndarray, shift: tuple[float, ...], amplitude2: float) -> np.ndarray:
    """The scaled field of a rigid motion x = R X + shift."""
    flat = np.pad(points, ((0, 0), (0, 1)))
    displacement = flat @ rotation.T + np.array(shift) - flat
    return displacement / np.array([amplitude2, amplitude2, np.sqrt(amplitude2)])


MOTIONS = {
    "translation": (Rotation.identity(), (0.2, -0.1, 0.3)),
    "about z": (Rotation.from_euler("z", 40, degrees=True), (0.0, 0.0, 0.0)),
    "out of plane": (Rotation.from_euler("x", 65, degrees=True), (0.0, 0.0, 0.0)),
    "any": (Rotation.from_euler("zxz", [20, 50, -70], degrees=True), (0.1, 0.2, -0.3)),
}


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
@pytest.mark.parametrize("amplitude2", [1e-3, 0.5])
def test_rigid_motion_costs_nothing(coarse, off_centre, points, motion, amplitude2):
    rotation, shift = motion
    membrane = Membrane(Geometry.build(coarse, off_centre), Groups(amplitude2, 0.0, 0.0, 0.34))
    field = moved(points, rotation.as_matrix(), shift, amplitude2)
    round_off = 1e-13 / amplitude2
    assert abs(membrane.energy(field)) < round_off**2
    assert np.abs(membrane.residual(field)).max() < 30.0 * round_off * np.abs(field).max()


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
def test_energy_does_not_see_a_rigid_motion_on_top(coarse, off_centre, points, random_field, motion):
    """Objectivity, with pretension: only a formula with every Green-Lagrange term passes."""
    (rotation, shift), amplitude2 = motion, 0.4
    membrane = Membrane(Geometry.build(coarse, off_centre), Groups(amplitude2, 0.0, 0.6, 0.34))
    field = random_field(coarse, 9)
    scale = np.array([amplitude2, amplitude2, np.sqrt(amplitude2)])
    turned = moved(points, rotation.as_matrix(), shift, amplitude2) + (field * scale) @ rotation.as_matrix().T / scale
    assert membrane.energy(turned) == pytest.approx(membrane.energy(field), rel=1e-11)


# Rung 3: the patch test


@pytest.mark.parametrize("tension", [0.0, 0.5])
def test_patch(coarse, off_centre, points, tension):
    """A linear field: stress constant and as Hooke says, no out-of-balance force inside, only on the rim."""
    gradient = np.array([[0.3, -0.1, 0.4], [0.2, 0.1, -0.6]])
    groups = Groups(0.2, 0.0, tension, 0.34)
    membrane = Membrane(Geometry.build(coarse, off_centre), groups)
    field = points @ gradient
    f = physical(gradient, groups.amplitude2)
    e = 0.5 * (f.T @ f - np.eye(2)) / groups.amplitude2
    s = ((1 - groups.poisson) * e + groups.poisson * np.trace(e) * np.eye(2)) / (1 - groups.poisson**2)
    _, total = membrane._stretch_and_stress(field)
    np.testing.assert_allclose(total - [s[0, 0] + tension, s[1, 1] + tension, s[0, 1]], 0.0, atol=1e-12)
    residual = membrane.residual(field)
    assert np.abs(residual[: coarse.n_free]).max() < 1e-13
    assert np.abs(residual[coarse.n_free :]).max() > 1e-2


def test_stiffened_adds_tension():
    assert Groups(0.1, 1.0, 0.2, 0.3).stiffened(0.5) == Groups(0.1, 1.0, 0.7, 0.3)


def test_gradient_of_a_linear_function_is_constant(coarse: Template, off_centre, points):
    geometry = Geometry.build(coarse, off_centre)
    slope = np.einsum("epan,en->epa", geometry.gradient, (points @ [2.0, -3.0])[coarse.nodes])
    np.testing.assert_allclose(slope - [2.0, -3.0], 0.0, atol=1e-11)
