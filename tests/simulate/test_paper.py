"""The paper's page, computed once with few presses and coarse meshes; its arithmetic against numpy and closed forms."""

import json
import re
import xml.etree.ElementTree
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from isocharge.common.errors import OutputExists
from isocharge.simulate import Circle, Fix, ForwardMap, Meeting, Resolution, Theory, load_sensor
from isocharge.simulate.execution.workers import Workers
from isocharge.simulate.forward import forward_map
from isocharge.simulate.paper import Choices, figure_contours, solves, write_paper
from isocharge.simulate.paper.choices import PAPER, normalised_cubic
from isocharge.simulate.paper.equation_4 import ChargeForce
from isocharge.simulate.paper.figure_layouts import trilaterate
from isocharge.simulate.paper.solves import SolveJob, solve_presses
from isocharge.simulate.paper.triangulation_errors import Errors
from isocharge.simulate.plots import figure
from isocharge.simulate.solver.settings import SolveSettings

FIGURES = [f"Fig. {number}" for number in range(1, 13)]
SMALL = replace(
    Choices.quick(),
    degree=3,
    length=16e-3,
    probes=(Circle(2e-3),),
    presses=16,
    force=(0.05, 0.2, 0.5, 1.0, 2.0),
    spacing=0.8e-3,
)
"""The paper's three probes, and lines long enough for its contours to cross; fewer presses and films."""

MEMBRANE = Theory(stretching=True, bending=False, pretensioned=False)


def coarse_map(job: solves.MapJob) -> ForwardMap:
    """The forward map of a job as a membrane, on the coarsest mesh that passes its check."""
    settings = SolveSettings(theory=MEMBRANE, resolution=Resolution(4, 8, 6))
    return ForwardMap.build(job.sensor, job.probe, job.radius, (1.0, 1.0), settings)


def coarse_presses(job: SolveJob) -> np.ndarray:
    """Single presses to 2 %."""
    return solve_presses(replace(job, accuracy=2e-2))


@pytest.fixture(scope="module")
def progress_calls() -> dict[str, list[tuple[int, int]]]:
    return {"solved": [], "triangulated": [], "drawn": []}


@pytest.fixture(scope="module")
def folder(tmp_path_factory, progress_calls):
    path = tmp_path_factory.mktemp("paper") / "page"
    progress = {
        name: (lambda done, total, calls=calls: calls.append((done, total))) for name, calls in progress_calls.items()
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figure, "DPI", 40)
        patch.setattr(solves, "build_map", coarse_map)
        patch.setattr(solves, "solve_presses", coarse_presses)
        patch.setattr(solves, "UNSUSPECTED", 4)
        patch.setattr(forward_map, "CHECKS", 4)
        patch.setattr(figure_contours, "LEVELS", 4)
        patch.setattr(solves, "MESHES", solves.MESHES[:3])
        patch.setattr(solves, "FINEST", (5, 8, 6, 1))
        write_paper(path, SMALL, Workers(), **progress)
    return path


@pytest.fixture(scope="module")
def numbers(folder):
    return json.loads((folder / "paper.json").read_text("utf-8"))


def test_every_heading_is_there(folder, numbers):
    page = (folder / "paper.md").read_text("utf-8")
    headings = re.findall(r"^## (.+)$", page, re.MULTILINE)
    assert headings == ["Table", *FIGURES, "Eq. 4", "Claims", "What the paper does not give"]
    assert list(numbers) == headings[1:]


def test_every_picture_is_there_twice_and_shown(folder):
    page = (folder / "paper.md").read_text("utf-8")
    slugs = [f"fig-{number:02d}" for number in range(1, 13)] + ["eq-04"]
    names = {f"{slug}.{kind}" for slug in slugs for kind in ("png", "svg")} | {"paper.md", "paper.json"}
    assert {path.name for path in folder.iterdir()} == names
    assert set(re.findall(r"\]\((.+?\.(?:png|svg))\)", page)) == names - {"paper.md", "paper.json"}
    for slug in slugs:
        with Image.open(folder / f"{slug}.png") as picture:
            assert min(picture.size) > 100
            assert len(picture.convert("L").getcolors()) > 10
        text = "".join(xml.etree.ElementTree.parse(folder / f"{slug}.svg").getroot().itertext())
        assert "mm" in text or "force, N" in text


def test_the_table_has_a_row_for_every_figure_with_the_papers_value(folder):
    rows = re.findall(
        r"^\| ((?:Fig\.|Eq\.) \d+) \| (.+) \| (.+) \| (.+) \| (.+) \|$", (folder / "paper.md").read_text(), re.M
    )
    assert {row[0] for row in rows} == {*FIGURES, "Eq. 4"}
    assert all(len(cell) > 1 and "nan" not in cell for row in rows for cell in row)
    assert any("0.122 mm" in row[2] for row in rows)


def test_progress_counts_to_the_total(folder, progress_calls):
    assert folder.exists()
    for calls in progress_calls.values():
        total = calls[-1][1]
        assert calls == [(done, total) for done in range(1, total + 1)]


@pytest.mark.parametrize(
    ("heading", "probe", "electrode"), [("Fig. 6", SMALL.triangle, 0), ("Fig. 8", SMALL.rectangle, 1)]
)
def test_charges_on_the_page_are_presses_of_the_papers_probe(numbers, heading, probe, electrode):
    """Against a direct solve with the paper's readout, near the electrode, where the probe's shape counts."""
    sensor, curves = replace(load_sensor("three-25um-biaxial"), readout="edge"), numbers[heading]
    angle, distance = np.deg2rad(curves["angle_deg"][2]), 1e-3 * curves["distance_mm"][0]
    x, y = sensor.electrodes[electrode].centre + distance * np.array([np.cos(angle), np.sin(angle)])
    direct = 1e12 * solve_presses(SolveJob((sensor,), probe, ((x, y),), (1.0,)))[0, 0, electrode]
    assert curves["charge_pC"][2][0] == pytest.approx(direct, rel=2e-3)


def test_contours_of_the_triangle_are_not_those_of_the_circle(numbers):
    """Fig. 11, over the working area: the shape changes a charge by less than 1 % in the middle, more beside B."""
    assert 1e-4 < numbers["Fig. 11"]["triangle_against_circle_median"] < 1e-2
    assert numbers["Fig. 11"]["triangle_against_circle_worst"] > 1e-2


def test_eq_4_is_a_membranes(numbers):
    """Normalised charge at 25 um within 0.02 of the paper's cubic; the thick film far from it."""
    films = {(film["thickness_um"], film["pretension_MPa"]): film for film in numbers["Eq. 4"]["films"]}
    assert films[25.0, 0.0]["misfit"] < 0.02
    assert films[25.0, 0.0]["exponent"]["1_N"] == pytest.approx(2.0 / 3.0, abs=5e-3)
    assert films[1000.0, 0.0]["misfit"] > 1.0
    assert films[1000.0, 0.0]["exponent"]["0.1_N"] == pytest.approx(2.0, abs=0.02)
    assert max(films[1000.0, 0.0]["charge_pC"][-1]) < 100.0
    x, y = numbers["Eq. 4"]["press_of_eq_4_mm"]
    assert np.hypot(x, y + 10.0) == pytest.approx(4.0, abs=0.5)


def test_contours_from_the_field_meet_at_the_press(numbers):
    assert numbers["Fig. 9"]["p50_mm"] < 0.005
    assert numbers["Fig. 9"]["met"] >= 8


@pytest.mark.parametrize("contours", ["three_degree_3", "four_degree_3"])
def test_graphical_contours_miss_the_press(numbers, contours):
    """By far more than those from the field; the paper's 0.122 mm lies between the right quantiles."""
    errors = numbers["Fig. 10"][contours]
    assert errors["p50_mm"] > 10.0 * numbers["Fig. 9"]["p50_mm"]
    assert sum(errors[status.name] for status in Meeting) == errors["presses"]
    assert errors["met"] >= 4
    smaller = errors["percentile_of_0.122_mm"] / 100.0 * errors["met"]
    assert smaller == pytest.approx(round(smaller))
    for share in (25, 50, 75, 95):
        rank = share / 100.0 * (errors["met"] - 1)  # between two presses the quantile is interpolated
        assert errors[f"p{share}_mm"] <= 0.122 or rank > smaller - 1
        assert errors[f"p{share}_mm"] > 0.122 or rank < smaller


def test_a_folder_that_is_there_is_left_alone(tmp_path):
    (tmp_path / "mine").mkdir()
    with pytest.raises(OutputExists, match="mine is already there"):
        write_paper(tmp_path / "mine", SMALL)
    assert list((tmp_path / "mine").iterdir()) == []


def test_nothing_is_left_when_it_fails(tmp_path, monkeypatch):
    def fail(*_):
        raise ArithmeticError("no")

    monkeypatch.setattr("isocharge.simulate.paper.build.solve_all", fail)
    with pytest.raises(ArithmeticError):
        write_paper(tmp_path / "new", SMALL)
    assert list(tmp_path.iterdir()) == []


# Its arithmetic


def test_errors_are_of_the_presses_that_were_located():
    """3-4-5 triangles of 0.05, 0.10, ..., 0.50 mm, and one press without a position."""
    length, zero = 0.05e-3 * np.arange(1, 11), np.zeros(11)
    x, y = np.append(0.6 * length, np.nan), np.append(0.8 * length, np.nan)
    status = np.append(np.full(10, Meeting.met), Meeting.apart)
    errors = Errors(Fix(x + 1e-3, y - 2e-3, zero, zero, status, zero), np.tile([1e-3, -2e-3], (11, 1)))
    np.testing.assert_allclose(errors.found_mm, 0.05 * np.arange(1, 11))
    assert errors.share_found == pytest.approx(10 / 11)
    assert errors.percentile(50) == pytest.approx(0.275)
    assert errors.share_below(0.122) == pytest.approx(20.0)
    assert errors.share_below(0.04) == 0.0


def test_trilateration_is_the_inverse_of_distances():
    rng = np.random.default_rng(2)
    centres, at = rng.standard_normal((3, 2)), rng.standard_normal(2)
    np.testing.assert_allclose(trilaterate(centres, np.linalg.norm(centres - at, axis=1)), at, atol=1e-12)


def test_normalised_cubic_is_the_designs():
    """(0.0865, -0.4055, 1.1938, 0.1253), and 1 at 1 N."""
    force = np.array([0.25, 0.7, 1.0, 2.0])
    np.testing.assert_allclose(normalised_cubic(force), np.polyval([0.0865, -0.4055, 1.1938, 0.1253], force), rtol=5e-4)
    assert sum(PAPER.cubics[0]) == pytest.approx(1460.8)


@pytest.mark.parametrize("exponent", [2.0 / 3.0, 1.0, 2.0])
def test_power_laws(exponent):
    """Exponent, distance from a line and the cubic of Q = F^n."""
    from scipy.interpolate import CubicSpline

    force = np.geomspace(0.05, 2.0, 9)
    film = ChargeForce(25e-6, 0.0, CubicSpline(np.log(force), exponent * np.log(force) + np.log(1e-9)))
    assert film.exponent(0.7) == pytest.approx(exponent)
    fine = np.linspace(0.25, 2.0, 352)
    np.testing.assert_allclose(film.cubic, np.polyfit(fine, fine**exponent, 3), atol=2e-3)
    line = np.linspace(0.05, 0.5, 91)
    slope = np.sum(line ** (1.0 + exponent)) / np.sum(line**2)
    expected = np.abs(line**exponent - slope * line).max() / 0.5**exponent
    assert film.bent(0.5) == pytest.approx(expected, abs=1e-9)
    assert (film.bent(0.5) < 1e-9) == (exponent == 1.0)
