"""The choice of a mesh: the same for a press and for the family that it belongs to, and nothing done twice."""

import numpy as np
import pytest

from isocharge.common.errors import SceneError
from isocharge.simulate import Circle, Film, Polygon, Resolution, SolveSettings, press
from isocharge.simulate.mesh.elements import Geometry
from isocharge.simulate.solver.press import needed_resolution

FILM = Film(45e-3, 25e-6, 3e9, 0.34)
INNER = (Circle(1e-3), (8e-3, 2e-3), 1.0)
NEAR_THE_RIM = (Circle(1e-3), (33e-3, 5e-3), 1.0)
LARGE_POLYGON = (Polygon.rectangle(8e-3, 2e-3), (3e-3, 0.0), 1.0)


@pytest.mark.parametrize("scene", [INNER, NEAR_THE_RIM, LARGE_POLYGON], ids=["inner", "rim", "large polygon"])
def test_needed_resolution_is_that_of_the_press(scene):
    assert needed_resolution(FILM, *scene) == press(FILM, *scene).resolution


def test_needed_resolution_is_known_without_a_solve_where_shapes_predict_the_error(monkeypatch):
    monkeypatch.setattr("isocharge.simulate.solver.press.press", lambda *_, **__: pytest.fail("solved a press"))
    assert needed_resolution(FILM, *INNER).order == 5
    given = Resolution(4, 8, 4)
    assert needed_resolution(FILM, *NEAR_THE_RIM, SolveSettings(resolution=given)) == given


def test_needed_resolution_refuses_what_a_press_refuses():
    for at in ((44.5e-3, 0.0), (np.nan, 0.0)):
        with pytest.raises(SceneError):
            needed_resolution(FILM, Circle(1e-3), at, 1.0)


def test_geometry_of_a_mesh_is_built_once(monkeypatch):
    """For choice, solve and error estimate together: as often as meshes are tried, each other points."""
    built, build = [], Geometry.build.__func__

    def counted(cls, template, points):
        built.append((template.resolution, points.tobytes()))
        return build(cls, template, points)

    monkeypatch.setattr(Geometry, "build", classmethod(counted))
    for scene in (INNER, NEAR_THE_RIM):
        built.clear()
        assert press(FILM, *scene).mesh_error > 0.0
        assert built
        assert len(set(built)) == len(built)
