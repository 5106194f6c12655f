"""The examples run, and reach what a quick training should."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.slow
def test_the_pipeline_runs_from_sweep_to_contact(tmp_path, capsys):
    spec = importlib.util.spec_from_file_location("pipeline", ROOT / "train" / "examples" / "pipeline.py")
    pipeline = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pipeline)
    contact = pipeline.main(tmp_path / "out", quick=True)
    assert abs(contact.x_mm - 3.0) < 0.3
    assert abs(contact.y_mm + 2.0) < 0.3
    assert abs(contact.force_N - 1.0) < 0.03
    assert "position_median_mm" in capsys.readouterr().out
