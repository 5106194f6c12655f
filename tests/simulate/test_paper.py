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


def test_every_figure_is_drawn_and_shown(folder):
    page = (folder / "paper.md").read_text("utf-8")
    assert all(f"## {heading}" in page for heading in (*(f"Fig. {number}" for number in range(1, 13)), "Eq. 4"))
    assert len([*folder.glob("*.png")]) == len([*folder.glob("*.svg")]) == 13
    assert "nan" not in page


def test_numbers_are_those_of_closed_forms(folder):
    """Three circles, an equilateral triangle, a slack membrane, a thick plate beside eq. 4, contours from the field."""
    numbers = json.loads((folder / "paper.json").read_text("utf-8"))
    assert numbers["Fig. 1"]["error_mm"] < 1e-12
    assert numbers["Fig. 3"]["sides_mm"] == pytest.approx([300**0.5] * 3, rel=1e-6)
    thin = numbers["Eq. 4"]["films"][0]
    thick = numbers["Eq. 4"]["films"][-2]
    assert [*thin["exponent"].values()] == pytest.approx([2 / 3] * 4, abs=0.01)
    assert thin["misfit"] < 0.02
    assert thick["thickness_um"] == 1000.0
    assert max(thick["charge_pC"][2]) < 0.01 * 1460
    assert numbers["Fig. 9"]["p50_mm"] < 1e-3
