"""An export on emulated Cortex-M boards: answers, instructions per prediction, flash, RAM; no times without a chip.

    python tests/benchmarks/bench_cortex_m.py --export c

The export is a folder of `isocharge train export-c`. QEMU emulates Arm's MPS2 boards with a Cortex-M4F (AN386) and a
Cortex-M7 (AN500) and counts instructions (`-icount shift=0`). Flash and RAM are those of the smallest program that
predicts, with its start-up code and the C library's functions; RAM is its data and its stack.
"""

import subprocess
import tempfile
from pathlib import Path

from shared import arguments, print_results

SOURCES = Path(__file__).parents[1] / "train" / "export_c" / "board"

OPTIONS = (
    "-mthumb -mfloat-abi=hard -std=c99 -O2 -ffp-contract=fast -fno-math-errno -ffunction-sections -fdata-sections "
    "-DISOCHARGE_CHAIN_FLOAT"
)
COUNTED = (
    "golden_vectors_wrong",
    "known_loop_of_4000",
    "instructions_per_prediction",
    "instructions_per_frame",
    "instructions_per_frame_in_contact",
    "stack_bytes_of_prediction",
    "stack_bytes_of_frame",
)
"""The words that `measure.c` prints, in their order."""


BOARDS = {"mps2-an386": "-mcpu=cortex-m4 -mfpu=fpv4-sp-d16", "mps2-an500": "-mcpu=cortex-m7 -mfpu=fpv5-sp-d16"}
"""Emulated boards by their names in QEMU, and what a compiler must know of their processors."""


def measure(export: Path, board: str, folder: Path) -> dict[str, int]:
    """Compile an export for a board, run it, and count."""
    measuring = _link(export, board, folder / "measure.elf", "measure.c", "isocharge_chain.c")
    emulator = f"qemu-system-arm -M {board} -icount shift=0 -display none -serial none -monitor none"
    emulator += " -chardev stdio,id=out -semihosting-config enable=on,target=native,chardev=out -kernel"
    done = subprocess.run([*emulator.split(), measuring], capture_output=True, text=True, check=True, timeout=300)
    counted = dict(zip(COUNTED, (int(word, 16) for word in done.stdout.split()), strict=True))
    smallest = _link(export, board, folder / "smallest.elf", "smallest.c")
    sizes = subprocess.check_output(["arm-none-eabi-size", smallest], text=True).splitlines()[1].split()
    text, data, bss = map(int, sizes[:3])  # bytes of code and constants, of variables with a value, and without one
    ram_bytes = data + bss + counted["stack_bytes_of_prediction"]
    return {**counted, "flash_bytes": text + data, "ram_bytes": ram_bytes}


def _link(export: Path, board: str, output: Path, main: str, *parts: str) -> Path:
    """A program of an export for a board."""
    words = [*BOARDS[board].split(), *OPTIONS.split(), "-I", str(export), "-nostartfiles", "--specs=nano.specs"]
    words += ["-Wl,--gc-sections", "-T", str(SOURCES / "mps2.ld"), str(SOURCES / "start.c"), str(SOURCES / main)]
    words += [str(export / name) for name in ("isocharge_model.c", *parts)]
    subprocess.run(["arm-none-eabi-gcc", *words, "-lm", "-o", str(output)], check=True)
    return output


def main() -> None:
    asked = arguments(__doc__, export=Path("c"))
    with tempfile.TemporaryDirectory() as folder:
        print_results("cortex_m", asked, {board: measure(asked.export, board, Path(folder)) for board in BOARDS})


if __name__ == "__main__":
    main()
