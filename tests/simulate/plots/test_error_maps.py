"""Pictures of smallest possible errors, drawn for given errors."""

from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.colors import LogNorm

from isocharge.simulate import Circle, load_sensor, noise_model
from isocharge.simulate.identifiability.identification import LimitMap
from isocharge.simulate.layout.case import NO_NUISANCES, DesignCase, Nuisances
from isocharge.simulate.layout.design import Design, ErrorMap
from isocharge.simulate.numerics.disk import Rings
from isocharge.simulate.plots.error_maps import error_maps_picture, identification_picture

SENSOR = load_sensor("three-25um-biaxial")
PRESSES = 4.0 * np.array([[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [0.5, 1.0], [0.0, 0.0]])


@pytest.mark.parametrize(
    ("nuisances", "before", "known"),
    [(NO_NUISANCES, False, "without nuisances"), (Nuisances(), True, "with nuisances")],
)
def test_error_maps_picture_marks_the_position_of_the_largest_error(nuisances, before, known):
    errors = ErrorMap(PRESSES, np.ones(5), np.array([0.1, 0.2, 0.1, 3.0, 0.3]))
    case = DesignCase(SENSOR, 3, 4.0, nuisances=nuisances)
    figure = error_maps_picture(Design(case, SENSOR, 1.0, "", 0, errors if before else None, errors))
    maps = figure.axes[:-1]
    assert figure.get_size_inches().tolist() == [13.8 if before else 7.4, 6.0]
    assert (len(maps), known in figure.get_suptitle()) == (1 + before, True)
    for axes in maps:
        assert [line.get_xydata().tolist() for line in axes.lines] == [[[2.0, 4.0]]]
        assert "worst 3 mm (cross), rms 1.35 mm" in axes.get_title()
        assert axes.get_xlim() == pytest.approx((-12.5, 12.5))  # a millimetre beyond the electrodes
        (shades,) = axes.collections
        assert (type(shades.norm), *shades.get_clim()) == (LogNorm, 0.1, 1.0)


def test_identification_picture_shows_the_error_against_distance():
    """The errors are proportional to distance / force. On each ring, the largest error is twice the median."""
    rings = Rings.spread(6.0)
    shape = rings.position.shape[:2]
    uneven = np.linspace(0.0, 2.0, shape[1])
    maps = [LimitMap(force, rings, rings.distance[:, None] * uneven / force, *[np.ones(shape)] * 2) for force in (1, 2)]
    area = SimpleNamespace(folds=np.array([[3.0, 0.0]]), radius=2.5, search_radius=6.0, error=1.0, fold_radius=3.0)
    noise = noise_model("reference")
    probe = Circle(1.0)
    figure = identification_picture(SimpleNamespace(maps=maps, area=area, sensor=SENSOR, noise=noise, probe=probe))
    weak, strong, curves, _ = figure.axes
    for axes, force in ((weak, 1), (strong, 2)):
        assert axes.get_title() == f"{force} N; dashed: working area, 2.5 mm; red: folds"
        assert axes.get_xlim() == (-6.0, 6.0)
    lines = [line.get_xydata() for line in curves.lines]
    for number, (force, factor) in enumerate([(1, 1.0), (1, 2.0), (2, 1.0), (2, 2.0)]):
        assert lines[number] == pytest.approx(np.column_stack([rings.distance, factor * rings.distance / force]))
    assert lines[0][:, 0].max() <= curves.get_xlim()[1] == 6.0
    colours = [line.get_color() for line in curves.lines]
    assert colours[0] == colours[1] != colours[2] == colours[3] == colours[4]  # the strongest in ink
    assert [line[0, 0] for line in lines[-2:]] == [2.5, 3.0]
