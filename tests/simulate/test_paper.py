"""The reproduction of the paper: its numbers compared with closed forms and with the printed eq. 4, and its files."""

import json
import subprocess
import sys

import pytest

from kept import ROOT

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
    """Five numbers of the page are known from closed forms or from eq. 4.

    They are the intersection of three circles (Fig. 1), the sides of the equilateral triangle of the electrodes
    (Fig. 3), the exponent 2/3 of a membrane without pretension, the small charge of a thick film (both eq. 4), and the
    error of contours without noise (Fig. 9).
    """
    numbers = json.loads((folder / "paper.json").read_text("utf-8"))
    assert numbers["Fig. 1"]["error_mm"] < 1e-12
    assert numbers["Fig. 3"]["sides_mm"] == pytest.approx([300**0.5] * 3, rel=1e-6)
    thin_film = numbers["Eq. 4"]["films"][0]
    assert [*thin_film["exponent"].values()] == pytest.approx([2 / 3] * 4, abs=0.01)
    assert thin_film["misfit"] < 0.02
    thick_film = numbers["Eq. 4"]["films"][-2]
    assert thick_film["thickness_um"] == 1000.0
    charge_at_1_N = thick_film["charge_pC"][numbers["Eq. 4"]["force_N"].index(1.0)]
    charge_of_eq_4 = 1460  # pC, of electrode A at 1 N
    assert max(charge_at_1_N) < 0.01 * charge_of_eq_4
    assert numbers["Fig. 9"]["p50_mm"] < 1e-3
