"""Pictures of smallest possible errors, drawn for given errors."""

import numpy as np
import pytest

from isocharge.simulate import load_sensor
from isocharge.simulate.identifiability.mirror_region import MirrorRegion
from isocharge.simulate.layout.case import NO_NUISANCES, DesignCase, Nuisances
from isocharge.simulate.layout.design import Design, ErrorMap
from isocharge.simulate.plots.error_maps import error_maps_picture, mirror_picture

SENSOR = load_sensor("three-25um-biaxial")
PRESSES = 4.0 * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [0.5, 1.0], [0.0, 0.0]])


@pytest.mark.parametrize(
    ("nuisances", "before", "known"),
    [(NO_NUISANCES, False, "without nuisances"), (Nuisances(), True, "with nuisances")],
)
def test_error_maps_picture_marks_the_position_of_the_largest_error(nuisances, before, known):
    errors = ErrorMap(PRESSES, np.ones(5), np.array([0.1, 0.2, 0.1, 3.0, 0.3]))
    case = DesignCase(SENSOR, 3, 4.0, nuisances=nuisances)
    figure = error_maps_picture(Design(case, SENSOR, "", 0, errors if before else None, errors))
    *maps, _colour_bar = figure.axes
    assert (len(maps), known in figure.get_suptitle()) == (1 + before, True)
    for axes in maps:
        assert [line.get_xydata().tolist() for line in axes.lines] == [[[2.0, 4.0]]]
        assert "worst 3 mm (cross), rms 1.35 mm" in axes.get_title()
        (shades,) = axes.collections
        assert shades.get_clim() == (0.1, 1.0)


def test_mirror_picture_divides_the_rings_into_sectors():
    mirror = MirrorRegion(8.0, 10.0, np.array([0.1, 1.0]), np.array([[0.0, 0.1, 0.2, 0.3], [1.0, 0.5, 0.0, 0.0]]))
    axes = mirror_picture(SENSOR, mirror).axes[0]
    shades = axes.collections[0]
    corners = np.asarray(shades.get_coordinates()) @ [1.0, 1j]
    np.testing.assert_allclose(corners, np.outer([8.0, 9.0, 10.0], [1.0, 1j, -1.0, -1j, 1.0]), atol=1e-12)
    np.testing.assert_array_equal(shades.get_array(), mirror.share)
