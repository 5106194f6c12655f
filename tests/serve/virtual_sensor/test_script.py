"""Scripts stay in their area and their range of forces, and are smooth."""

import numpy as np
import pytest

from isocharge.common.errors import SceneError
from isocharge.serve import Faults, wander
from isocharge.serve.virtual_sensor.script import load_script


@pytest.fixture(scope="module")
def script():
    return wander(seed=5, seconds=120.0, rate_Hz=200.0, radius_mm=8.0, force_range_N=(0.05, 2.0))


def test_wander_stays_inside_radius_and_forces(script):
    on = script.touching
    x_mm, y_mm, force_N = script.contact[on].T
    assert 6.0 < np.hypot(x_mm, y_mm).max() <= 8.0
    assert force_N.min() == pytest.approx(0.05)
    assert 1.0 < force_N.max() <= 2.0 * (1 + 1e-12)
    assert np.isnan(script.contact[~on, :2]).all()


PRESSES = "presses = [[3, 1, 2, 0], [4, 1, 2, 0], [4.1, 1, 2, 0.5], [5.1, 3, 2, 0.5], [5.2, 3, 2, 0]]\n"


def test_load_script_reads_a_toml_file(tmp_path):
    path = tmp_path / "play.toml"
    path.write_text(PRESSES + "[faults]\nlose_share = 0.1\n")
    play = load_script(path)
    assert play.faults == Faults(lose_share=0.1)
    script = play.script(100.0)
    assert (script.contact.shape, script.rate_Hz) == ((220, 3), 100.0)
    assert np.isnan(script.contact[:101, 0]).all()
    assert script.contact[160] == pytest.approx([2.0, 2.0, 0.5])
    assert script.contact[105, 2] == pytest.approx(0.25)
    path.write_text("")
    assert load_script(path).script(100.0) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("presses = [[0, 0, 0, 0], [1e9, 0, 0, 0]]", r"presses\[1\]\[0\]: expected a number from -86400 to 86400, got"),
        ("presses = [[0, 1, 2]]", r"presses\[0\]: expected \[seconds, x_mm, y_mm, force_N\] with a force from 0, got"),
        ("presses = [[0, 1, 2, 1], [1, 1, 2, -1]]", r"presses\[1\]\[3\]: expected a number from 0, got -1"),
        ("presses = [[0, 1, 2, 1]]", "presses: expected two rows or more with growing seconds, got"),
        ("presses = [[1, 1, 2, 1], [0, 1, 2, 1]]", "presses: expected two rows or more with growing seconds, got"),
        ("[faults]\nlose_share = 1.1", r"faults.lose_share: expected a number from 0 to 1, got 1\.1"),
        ("[faults]\nlose_shar = 0.1", "unknown key 'faults.lose_shar'; did you mean 'lose_share'"),
    ],
)
def test_wrong_script_file_is_refused(text, message, tmp_path):
    path = tmp_path / "play.toml"
    path.write_text(text)
    with pytest.raises(SceneError, match=message):
        load_script(path)
