"""Stretching compared with an independent implementation of the formulas, with rigid motions and a patch test."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from isocharge.simulate.mechanics.energy import Membrane
from isocharge.simulate.mechanics.scaling import DimensionlessGroups
from isocharge.simulate.mechanics.stress import stress


def groups(squared_amplitude: float, tension: float, poisson: float = 0.34) -> DimensionlessGroups:
    return DimensionlessGroups(squared_amplitude, 0.0, tension, 0.0, poisson)


def physical(slope: np.ndarray, squared_amplitude: float) -> np.ndarray:
    """F = dx/dX, shape (3, 2), of the scaled gradient d(U1, U2, W)/d(X1, X2), shape (2, 3)."""
    return np.eye(3, 2) + (slope * np.array([squared_amplitude, squared_amplitude, np.sqrt(squared_amplitude)])).T


def green(slope: np.ndarray, squared_amplitude: float) -> np.ndarray:
    """Scaled Green-Lagrange strain, shape (2, 2)."""
    f = physical(slope, squared_amplitude)
    return 0.5 * (f.T @ f - np.eye(2)) / squared_amplitude


@pytest.mark.parametrize("poisson", [0.0, 0.34, 0.49])
def test_stress_solves_the_plane_stress_compliance(poisson):
    """Return the strain for a stress and Young's modulus 1 (Hooke's law)."""
    e11 = 0.3
    e22 = -0.2
    shear = 0.5
    s11, s22, s12 = stress(np.array([e11, e22, shear]), poisson)
    np.testing.assert_allclose([s11 - poisson * s22, s22 - poisson * s11, 2 * (1 + poisson) * s12], [e11, e22, shear])


# Rigid motions


def moved(points: np.ndarray, rotation: np.ndarray, shift: tuple[float, ...], squared_amplitude: float) -> np.ndarray:
    """The scaled field of a rigid motion x = R X + shift."""
    flat = np.pad(points, ((0, 0), (0, 1)))
    displacement = flat @ rotation.T + np.array(shift) - flat
    return displacement / np.array([squared_amplitude, squared_amplitude, np.sqrt(squared_amplitude)])


MOTIONS = {
    "translation": (Rotation.identity(), (0.2, -0.1, 0.3)),
    "about z": (Rotation.from_euler("z", 40, degrees=True), (0.0, 0.0, 0.0)),
    "out of plane": (Rotation.from_euler("x", 65, degrees=True), (0.0, 0.0, 0.0)),
    "any": (Rotation.from_euler("zxz", [20, 50, -70], degrees=True), (0.1, 0.2, -0.3)),
}


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS.keys())
@pytest.mark.parametrize("squared_amplitude", [1e-3, 0.5])
def test_rigid_motion_has_no_energy(mesh, motion, squared_amplitude):
    rotation, shift = motion
    membrane = Membrane(mesh.geometry, groups(squared_amplitude, 0.0))
    field = moved(mesh.points, rotation.as_matrix(), shift, squared_amplitude)
    round_off = 3e-13 / squared_amplitude
    assert abs(membrane.energy(field)) < round_off**2
    assert np.abs(membrane.forces(field)).max() < 30.0 * round_off * np.abs(field).max()


# The patch test, on elements with curved sides


@pytest.mark.parametrize("tension", [0.0, 0.5])
def test_patch_of_uniform_strain_is_exact(mesh, tension):
    """A linear field has the energy of Hooke's law, and out-of-balance forces on the boundary of the mesh only."""
    gradient = np.array([[0.3, -0.1, 0.4], [0.2, 0.1, -0.6]])
    scene = groups(0.2, tension)
    membrane = Membrane(mesh.geometry, scene)
    field = mesh.points @ gradient
    e = green(gradient, scene.squared_amplitude)
    nu = scene.poisson
    density = 0.5 / (1 - nu**2) * ((1 - nu) * np.sum(e * e) + nu * np.trace(e) ** 2)
    density += tension * (np.trace(e) - gradient[0, 0] - gradient[1, 1])
    assert membrane.energy(field) == pytest.approx(density * mesh.geometry.weights.sum(), rel=1e-11)
    forces = np.stack([mesh.geometry.gather(membrane.forces(field)[..., i]) for i in range(3)], axis=1)
    boundary = mesh.template.on_rim | mesh.template.on_axis
    assert np.abs(forces[~boundary]).max() < 1e-12
    assert np.abs(forces[boundary]).max() > 1e-2
