"""Other processors by emulation: the same answers, and what a Cortex-M counts in instructions, flash and RAM.

Packages of Debian: gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm.
"""

import importlib.util
import shutil
from pathlib import Path

import pytest

from isocharge.serve import find_model
from isocharge.train.export_c.folder import export_c

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def bench():
    """The benchmark on emulated boards."""
    spec = importlib.util.spec_from_file_location("bench_cortex_m", ROOT / "tests" / "benchmarks" / "bench_cortex_m.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    missing = [tool for tool in module.TOOLS if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")
    return module


@pytest.mark.parametrize("board", ["mps2-an386", "mps2-an500"])
@pytest.mark.parametrize(
    ("model", "instructions", "flash"),
    [
        ("three-25um-biaxial", (60_000, 130_000), 125_000),
        ("four-25um-biaxial-films", (60_000, 130_000), 125_000),
        ("four-25um-biaxial-student", (1, 60_000), 40_000),
    ],
)
def test_golden_vectors_agree_and_instructions_are_counted(board, model, instructions, flash, bench, tmp_path):
    counted = bench.measure(export_c(find_model(model), tmp_path / "c"), bench.BOARDS[board], tmp_path)
    assert counted["golden_vectors_agree"]
    assert counted["known_loop_of_4000"] == pytest.approx(4000, abs=2)
    assert instructions[0] < counted["instructions_per_prediction"] < instructions[1]
    assert counted["flash_bytes"] < flash
    assert counted["ram_bytes"] < 2_048
    assert 0 < counted["instructions_per_frame_in_contact"] < 1_000
