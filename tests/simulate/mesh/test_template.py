"""Topology of the mesh template: Euler characteristic and rotations."""

import numpy as np
import pytest

from isocharge.simulate import Circle, Ellipse, Film, Polygon, Resolution
from isocharge.simulate.mesh.template import Template, template_for

FILM = Film(45.0, 0.025, 3000.0, 0.34)
RESOLUTIONS = (Resolution(2, 8, 1), Resolution(4, 16, 3, 2))
PROBES = {
    "circle": Circle(1.0),
    "triangle": Polygon.triangle(3.0),
    "pentagon": Polygon.of(np.stack([np.cos(0.4 * np.pi * np.arange(5)), np.sin(0.4 * np.pi * np.arange(5))], axis=1)),
    "ellipse": Ellipse(4.0, 2.0),
}


@pytest.fixture(params=RESOLUTIONS, ids=str)
def resolution(request) -> Resolution:
    return request.param


@pytest.fixture(params=PROBES.values(), ids=PROBES)
def built(request, resolution) -> Template:
    return template_for(request.param, resolution)


@pytest.mark.parametrize("wrong", [(1, 8, 4, 0), (4, 3, 4, 0), (4, 8, 0, 0), (4, 8, 4, -1)])
def test_resolution_rejects_values_out_of_range(wrong):
    with pytest.raises(ValueError, match=f"got {wrong[0]}, {wrong[1]}, {wrong[2]}, {wrong[3]}"):
        Resolution(*wrong)
