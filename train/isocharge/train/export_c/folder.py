"""Writer of the folder of a C export, with the model, the signal chain of a board, examples and a README.

The folder is written completely or not at all.
"""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import structs

from isocharge.common.errors import DeviceError
from isocharge.common.files import new_folder, refuse_existing, write_whole
from isocharge.serve.live.device import ANY_BOARD, Device, DeviceSections
from isocharge.serve.live.reading_stream import check_channels
from isocharge.serve.model.model_folder import load_model
from isocharge.serve.signal_chain.chain import Chain
from isocharge.serve.signal_chain.hum import MIN_SQUARED_STEP
from isocharge.train.export_c.c_text import c_comment, c_double, c_doubles, source_text
from isocharge.train.export_c.model_source import model_header, model_source, self_test
from isocharge.train.model_release.onnx_graph import read_graph

log = logging.getLogger(__name__)

MAX_TARE_FRAMES = 10_000
"""Largest number of frames of a tare in C, which limits the memory that the C program needs."""

SWITCHES = {"HUM": "HUM", "TARE": "TARE_ON", "LEAK": "LEAK", "TOUCH": "TOUCH", "THERMAL": "THERMAL_ON"}
"""Name of the C constant that switches a stage on, by the prefix of the stage's other constants."""

C_NAMES = {"frequency_Hz": "HZ"}
"""Names in C of the settings whose name in C is not simply their name in capital letters."""


C_SECTIONS = frozenset({"frames", "channels", "gain", "saturation", "hum", "tare", "leak", "touch", "common_mode"})
"""Sections of a device file that a signal chain in C needs or that do not change its charges."""

HOST_SECTIONS = frozenset({"track", "follow", "touch_offset"})
"""Sections of a device file that process the contacts after the signal chain, and that only the host executes."""


def device_header(device: Device, electrodes: tuple[str, ...]) -> str:
    """Return the text of `isocharge_device.h`.

    Args:
        device: The board.
        electrodes: Names of the electrodes in the order of the model.

    Raises:
        DeviceError: If the device file is for other electrodes, if its tare is too long for C, or if it uses a stage
            that does not exist in C.
    """
    _check_exists_in_c(device)
    chain = device.chain(electrodes)
    # A chain without zeros subtracts nothing, and a chain without gains reads charges in pC.
    zero = np.zeros(len(electrodes)) if chain.zero is None else chain.zero
    gain_pC = np.ones(len(electrodes)) if chain.gain_pC is None else chain.gain_pC
    has_saturation = chain.limit_pC is not None
    numbers = {
        "ZERO": c_doubles(zero),
        "GAIN_PC": c_doubles(gain_pC),
        "LARGEST": c_double(chain.largest),
        "SATURATION": str(int(has_saturation)),
        "HUM_LEAST_TURN": c_double(MIN_SQUARED_STEP),  # smallest squared step of the phasor of the hum
    }
    if chain.limit_pC is not None:
        numbers["LIMIT_PC"] = c_double(chain.limit_pC)
    for prefix, settings in _stage_settings(chain).items():
        numbers.update(_stage_numbers(prefix, settings))
    lines = "\n".join(f"#define ISOCHARGE_{name} {text}" for name, text in numbers.items())
    return source_text("isocharge_device.h", origin=settings_origin(device), lines=lines)


def settings_origin(device: Device) -> str:
    """Return words that state where the settings of the signal chain come from, for comments and the README."""
    if device is ANY_BOARD:
        return "the defaults, because no device file was given"
    return f'from the device file "{c_comment(device.name)}"'


def _stage_numbers(prefix: str, settings: Mapping[str, Any]) -> dict[str, str]:
    """Return the settings of a stage as C literals, by the names of their macros without `ISOCHARGE_`.

    The first macro switches the stage on: its literal is 1 if the stage is on, and 0 otherwise.

    Args:
        prefix: Prefix of the macros of the stage, for example "TARE".
        settings: Settings of the stage with its switch `on`; empty for a stage that is not in the chain.
    """
    is_on = settings.get("on", False)
    numbers = {SWITCHES[prefix]: str(int(is_on))}
    for name, value in settings.items():
        if name == "on":
            continue
        c_name = C_NAMES.get(name, name.upper())
        numbers[f"{prefix}_{c_name}"] = _c_literal(value)
    return numbers


def _stage_settings(chain: Chain) -> dict[str, dict[str, Any]]:
    """Return the settings of each stage of a signal chain, by the prefix of the C macros of the stage.

    A stage is one step of the signal processing, such as the tare. If a stage is missing in the chain, its settings are
    empty. The switch `on` of a stage is one of its settings.

    Args:
        chain: The signal chain.
    """
    # A chain has settings of the leak in any case. Without a time constant, the charges do not leak.
    leak = None if chain.tau_s is None else chain.leak
    stages = {"HUM": chain.hum, "TARE": chain.tare, "LEAK": leak, "TOUCH": chain.touch, "THERMAL": chain.thermal}
    settings_by_prefix: dict[str, dict[str, Any]] = {}
    for prefix, stage in stages.items():
        settings = {} if stage is None else structs.asdict(stage)
        settings.pop("pC_per_K", None)  # a chain in C has no pyroelectric charges
        settings_by_prefix[prefix] = settings
    if leak is not None:
        # The settings of the leak contain a single time constant. The time constants of the chain, one for each
        # electrode, replace it. They become the first setting, and the macros are written in the order of the settings.
        leak_settings = settings_by_prefix["LEAK"]
        del leak_settings["tau_s"]
        settings_by_prefix["LEAK"] = {"tau_s": chain.tau_s, **leak_settings}
    return settings_by_prefix


def _check_exists_in_c(device: Device) -> None:
    """Raise an error if the signal chain of a board cannot be exported to C, and warn of sections that C ignores.

    Args:
        device: The board.

    Raises:
        DeviceError: If the tare is too long for the memory of the C program, or the device file has a stage that does
            not exist in C.
    """
    where = device.where
    if device.tare is not None and not 1 <= device.tare.frames <= MAX_TARE_FRAMES:
        raise DeviceError(
            f"{where}: tare.frames: expected a whole number from 1 to {MAX_TARE_FRAMES} for a signal chain in C, which "
            f"stores all frames of the tare, got {device.tare.frames}"
        )
    names = [section.name for section in structs.fields(DeviceSections) if section.name != "name"]
    unknown = [name for name in names if name not in C_SECTIONS and getattr(device, name) is not None]
    refused = [name for name in unknown if name not in HOST_SECTIONS]
    if device.common_mode is not None and device.common_mode.pC_per_K is not None:
        refused.append("common_mode.pC_per_K")
    if refused:
        raise DeviceError(
            f"{where}: {', '.join(refused)}: this stage does not exist in the signal chain in C; remove it from the "
            "device file, or run `isocharge serve stream` on a host"
        )
    if unknown:
        log.warning("%s: %s: not exported, because only `isocharge serve stream` does this", where, ", ".join(unknown))


def _c_literal(value: Any) -> str:
    """Return a number, a truth value or an array as a C literal. A truth value becomes 0 or 1.

    Args:
        value: The number, truth value or array.
    """
    if isinstance(value, np.ndarray):
        return c_doubles(value)
    if isinstance(value, int):  # truth values are integers as well
        return str(int(value))
    return c_double(value)


SKETCH = "isocharge_sketch"
"""Name of the Arduino sketch, of its folder and of the file in the folder."""

BOARD_SOURCES = ("isocharge_chain.h", "isocharge_chain.c", "isocharge_frames.h", "isocharge_frames.c")
"""Files that are the same for every model. The sketch contains copies of these files."""

SINGLE_PRECISION = "/* This board computes the chain in single precision. */\n#define ISOCHARGE_CHAIN_FLOAT\n\n"
"""Text that switches the signal chain of the sketch to single precision."""


def export_c(model: Path, output: Path, device: Device = ANY_BOARD, *, command: str = "") -> Path:
    """Write a model and the signal chain of a board as a folder of C99 files.

    Args:
        model: Version folder of the model, as `find_model` returns it.
        output: Folder to create.
        device: Board, for the settings of its signal chain.
        command: Command that makes this folder again, for the README.

    Returns:
        The folder.

    Raises:
        ModelError: If the model is missing or damaged, or its graph was not written by isocharge.
        DeviceError: If the device file is for other electrodes.
        ChargeError: If the device file has no channel for an electrode.
        OutputExists: If the folder exists.
        OutputError: If the file system refuses to write. In this case, no files remain.
    """
    refuse_existing(output)
    files = c_files(model, device, command)
    with new_folder(output) as draft:
        for name, text in files.items():
            (draft / name).parent.mkdir(parents=True, exist_ok=True)
            write_whole(draft / name, text.encode())
    return output


def c_files(model: Path, device: Device = ANY_BOARD, command: str = "") -> dict[str, str]:
    """Return the texts of all files of an export, by their paths in the folder of the export.

    Args:
        model: Version folder of the model.
        device: Board, for the settings of its signal chain.
        command: Command that makes this folder again, for the README.

    Raises:
        ModelError: If the model is missing or damaged, or its graph was not written by isocharge.
        DeviceError: If the device file is for other electrodes.
        ChargeError: If the device file has no channel for an electrode.
    """
    loaded = load_model(model)
    path = loaded.folder / "model.onnx"
    metadata = loaded.metadata
    check_channels(device, metadata.electrodes, f"model {metadata.label}")
    network = read_graph(path.read_bytes(), str(path))
    # The README contains the command between backticks, so the command itself must not contain any.
    command_in_one_line = " ".join(command.replace("`", "'").split())
    example_charges = ["800.0f"] * len(metadata.electrodes)
    files = {
        "isocharge_model.h": model_header(metadata, network),
        "isocharge_model.c": model_source(metadata, network),
        "isocharge_device.h": device_header(device, metadata.electrodes),
        **{name: source_text(name) for name in (*BOARD_SOURCES, "host_example.c")},
        "self_test.c": self_test(loaded.golden, metadata),
        "README.md": source_text(
            "README.md",
            label=metadata.label,
            command=command_in_one_line or "isocharge train export-c",
            charges=", ".join(example_charges),
            electrodes=c_comment(", ".join(metadata.electrodes)),
            origin=settings_origin(device),
        ),
    }
    return files | _sketch_files(files, len(metadata.electrodes))


def _sketch_files(files: Mapping[str, str], n_electrode: int) -> dict[str, str]:
    """Return the texts of all files of the Arduino sketch, by their paths in the folder of the export.

    The sketch has a folder of its own, which contains copies of the sources. It computes in single precision.

    Args:
        files: Text of the files of the export by name.
        n_electrode: Number of electrodes, each of which has an analogue pin.
    """
    sketch = {name: files[name] for name in ("isocharge_model.h", "isocharge_model.c", *BOARD_SOURCES)}
    sketch["isocharge_device.h"] = SINGLE_PRECISION + files["isocharge_device.h"]
    pins = ", ".join(f"A{pin_index}" for pin_index in range(n_electrode))
    sketch[f"{SKETCH}.ino"] = source_text("sketch.ino", pins=pins)
    return {f"arduino/{SKETCH}/{name}": text for name, text in sketch.items()}
