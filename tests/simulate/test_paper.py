"""The paper's page: its numbers against closed forms and eq. 4 as printed, the files that it needs."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1200)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("paper") / "page"
    command = [sys.executable, ROOT / "simulate/examples/paper", "--quick", "--workers", "1", "-o", path]
    subprocess.run(command, check=True, timeout=1200)
    return path


@pytest.fixture(scope="module")
def numbers(folder):
    return json.loads((folder / "paper.json").read_text("utf-8"))


def test_every_figure_is_drawn_and_shown(folder, numbers):
    page = (folder / "paper.md").read_text("utf-8")
    for heading in (*(f"Fig. {number}" for number in range(1, 13)), "Eq. 4"):
        assert f"## {heading}" in page
        assert heading in numbers
    assert len([*folder.glob("*.png")]) == len([*folder.glob("*.svg")]) == 13
    assert "nan" not in page


def test_three_circles_meet_in_the_press(numbers):
    assert numbers["Fig. 1"]["error_mm"] < 1e-12


def test_the_triangle_is_equilateral(numbers):
    assert numbers["Fig. 3"]["sides_mm"] == pytest.approx([300**0.5] * 3, rel=1e-6)


def test_a_slack_membrane_s_charge_goes_with_the_force_to_two_thirds(numbers):
    thin = numbers["Eq. 4"]["films"][0]
    assert (thin["thickness_um"], thin["pretension_MPa"]) == (25.0, 0.0)
    assert [*thin["exponent"].values()] == pytest.approx([2 / 3] * 4, abs=0.01)
    assert thin["misfit"] < 0.02


def test_a_thick_film_cannot_give_the_charges_of_eq_4(numbers):
    thick = numbers["Eq. 4"]["films"][-2]
    assert thick["thickness_um"] == 1000.0
    assert max(thick["charge_pC"][2]) < 0.01 * 1460


def test_contours_from_the_field_meet_in_the_press(numbers):
    assert numbers["Fig. 9"]["p50_mm"] < 1e-3
