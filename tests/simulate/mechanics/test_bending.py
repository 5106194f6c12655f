"""Bending energy of plane fields, which is zero, and the lowest frequency of a clamped plate."""

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.optimize import brentq
from scipy.special import iv, jv

from isocharge.simulate import Circle, Polygon, Resolution
from isocharge.simulate.mechanics.energy import Bending

PROBES = [Circle(0.2), Polygon.triangle(0.4, 0.3), Polygon.rectangle(0.3, 0.2, 0.5)]
FINE = Resolution(8, 8, 4)


@pytest.fixture(scope="module", params=PROBES, ids=lambda probe: probe.notation.partition(":")[0])
def fine(request, mesh_of):
    return mesh_of(request.param, (0.3, 0.0), FINE)


def test_tilt_has_bending_energy_at_the_clamped_rim_only(fine):
    """A plane has no curvature inside the film, and a kink at the clamp. A constant W has no bending energy."""
    bent = Bending(fine.geometry, 1.0).laplacian(fine.points @ [0.5, 0.0])
    assert np.abs(bent[fine.inside]).max() < 1e-7
    assert np.abs(bent[fine.template.on_rim]).max() > 1.0
    assert Bending(fine.geometry, 1.0).energy(np.full(fine.template.n_node, 0.7)) < 1e-18


@pytest.mark.parametrize("probe", PROBES, ids=lambda probe: probe.notation.partition(":")[0])
def test_lowest_frequency_of_a_clamped_plate(mesh_of, probe):
    """The lowest mode of a clamped plate satisfies lap lap W = k^4 W with k = 3.1962 (Rayleigh 1894, art. 221).

    This k is the first root of J0(k) I1(k) + I0(k) J1(k) = 0.
    """
    k = brentq(lambda k: jv(0, k) * iv(1, k) + iv(0, k) * jv(1, k), 3.0, 3.4)
    mesh = mesh_of(probe, (0.3, 0.0), Resolution(4, 8, 4))
    geometry = mesh.geometry
    inside = np.flatnonzero(mesh.inside)
    mass = geometry.gather(geometry.mass)
    unit = np.eye(mesh.template.n_node)[:, inside]
    plate = np.stack([geometry.gather(Bending(geometry, 1.0).forces(column)) for column in unit.T], axis=1)[inside]
    lowest = eigh(plate, np.diag(mass[inside]), eigvals_only=True, subset_by_index=[0, 0])[0]
    assert lowest == pytest.approx(k**4, rel=2e-4)
