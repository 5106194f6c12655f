"""Other processors by emulation: the same answers, and what a Cortex-M counts in instructions, flash and RAM.

Packages of Debian: gcc-arm-none-eabi libnewlib-arm-none-eabi qemu-system-arm for the boards; for aarch64
gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user.
"""

import importlib.util
import shutil
import subprocess
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


def test_aarch64_answers_the_golden_vectors(exports, compile_c, tmp_path):
    if shutil.which("qemu-aarch64") is None:
        pytest.skip("qemu-aarch64 is not installed")
    for options in (("-O2", "-static"), ("-O3", "-ffp-contract=fast", "-static")):
        program = compile_c(
            "aarch64-linux-gnu-gcc",
            exports[0],
            tmp_path / "self_test",
            "self_test.c",
            "isocharge_model.c",
            options=options,
        )
        done = subprocess.run(["qemu-aarch64", program], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout
        assert "0 wrong numbers" in done.stdout


def test_the_chain_for_a_processor_without_double_needs_none(tmp_path):
    """No routine that computes with doubles in software is called."""
    if shutil.which("arm-none-eabi-gcc") is None:
        pytest.skip("arm-none-eabi-gcc is not installed")
    export = export_c(find_model("four-25um-biaxial"), tmp_path / "c")
    for source in ("isocharge_model.c", "isocharge_chain.c"):
        words = "-mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16 -std=c99 -O2 -DISOCHARGE_CHAIN_FLOAT -c"
        subprocess.run(["arm-none-eabi-gcc", *words.split(), source, "-o", tmp_path / "part.o"], cwd=export, check=True)
        symbols = subprocess.check_output(["arm-none-eabi-nm", tmp_path / "part.o"], text=True)
        assert "__aeabi_d" not in symbols
        assert "__aeabi_f2d" not in symbols
