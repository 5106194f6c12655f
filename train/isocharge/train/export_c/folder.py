"""Writer of the folder of a C export, with the model, the signal chain of a board, examples and a README.

The folder is written completely or not at all.
"""

import logging
from pathlib import Path
from typing import Any

import numpy as np

from isocharge.common.errors import DeviceError
from isocharge.common.files import new_folder, write_whole
from isocharge.serve.live.device import ANY_BOARD, STAGES
from isocharge.serve.model.model_folder import load_model
from isocharge.serve.signal_chain.stage import NOT_IN_C, Device, Setup, SUM_TOLERANCE_s
from isocharge.train.export_c.c_text import c_comment, source_text
from isocharge.train.export_c.model_source import model_header, model_source, self_test
from isocharge.train.model_release.onnx_graph import read_graph

log = logging.getLogger(__name__)


def device_header(device: Device, electrodes: tuple[str, ...], *, has_any_sign: bool = False) -> str:
    """Return the text of `isocharge_device.h`, which defines the settings of the signal chain as macros.

    A stage of the signal chain belongs to a section of a device file. A stage without a section has no settings and no
    macros. The C sources implement only some of the stages. The macro `ISOCHARGE_<SECTION>_ON` of an implemented stage
    is 1 if the stage is switched on. The other macros of the stage have the names of its settings in capital letters.

    The device file may also switch on a stage that is not implemented in C. If such a stage only processes contacts, it
    is left out with a warning, because a host can process the contacts as well. Any other such stage is an error,
    because the charges would be wrong.

    Args:
        device: The board.
        electrodes: Names of the electrodes in the order of the model.
        has_any_sign: Whether the charges of a touch may have any sign. Otherwise, most of them are positive.

    Raises:
        DeviceError: If the device file is for other electrodes, if its tare is too long for C, or if it uses a stage
            that does not exist in C.
    """
    setup = Setup(electrodes, device, has_any_sign=has_any_sign)
    if device.has_currents:
        raise DeviceError(
            f"{device.where}: front_end: the C code does not add up currents; run `isocharge serve stream` on a host"
        )
    macros = {"ISOCHARGE_SUM_TOLERANCE_S": _c_literal(SUM_TOLERANCE_s)}
    chain_source = source_text("isocharge_chain.c")
    host_sections = []
    for stage in STAGES:
        is_on = stage.rule_class in device.rules
        prefix = f"ISOCHARGE_{stage.section.upper()}_"
        is_in_c = prefix in chain_source  # the C source of an implemented stage uses its macros
        if is_in_c:
            settings = {"on": is_on, **stage.c_settings(setup)}
            macros |= {prefix + name.upper(): _c_literal(value) for name, value in settings.items()}
        elif stage.section and is_on:  # the device file switches on a stage that is not implemented in C
            if not stage.needs_contact:
                raise DeviceError(f"{device.where}: {stage.section}: {NOT_IN_C}")
            host_sections.append(stage.section)
    if host_sections:
        log.warning(
            "%s: %s: not exported, because only `isocharge serve stream` does this",
            device.where,
            ", ".join(host_sections),
        )
    lines = "\n".join(f"#define {name} {literal}" for name, literal in macros.items())
    return source_text("isocharge_device.h", origin=settings_origin(device), lines=lines)


def settings_origin(device: Device) -> str:
    """Return a phrase that states the origin of the settings of the signal chain, for comments and the README."""
    if device is ANY_BOARD:
        return "the defaults, because no device file was given"
    return f'from the device file "{c_comment(device.name)}"'


def _c_literal(value: Any) -> str:
    """Return a number or a truth value as a C literal, and an array as an initialiser.

    A truth value becomes 0 or 1. The numbers of an array are converted to the precision of the signal chain: the C type
    `isocharge_real` is `float` or `double`.

    Args:
        value: The number, truth value or array.
    """
    if isinstance(value, np.ndarray):
        return "{" + ", ".join(f"(isocharge_real){_c_literal(number)}" for number in value) + "}"
    if isinstance(value, int):  # truth values are integers as well
        return str(int(value))
    return repr(float(value))  # the shortest literal of a double


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
        DeviceError: If a setting of the device file is for other electrodes.
        OutputExists: If the folder exists.
        OutputError: If the file system refuses to write. In this case, no files remain.
    """
    files = c_files(model, device, command)
    with new_folder(output) as draft:
        for name, text in files.items():
            (draft / name).parent.mkdir(parents=True, exist_ok=True)
            write_whole(draft / name, text.encode())
    return output


def c_files(model: Path, device: Device, command: str) -> dict[str, str]:
    """Return the texts of all files of an export, by their paths in the folder of the export.

    The export contains the sources of the model and of the signal chain, a test of them, an example for a computer, and
    an Arduino sketch.

    Args:
        model: Version folder of the model.
        device: Board, for the settings of its signal chain.
        command: Command that makes this folder again, for the README.

    Raises:
        ModelError: If the model is missing or damaged, or its graph was not written by isocharge.
        DeviceError: If a setting of the device file is for other electrodes.
    """
    loaded = load_model(model)
    metadata = loaded.metadata
    n_electrode = len(metadata.electrodes)
    graph_path = loaded.folder / "model.onnx"
    network = read_graph(graph_path.read_bytes(), str(graph_path))

    # Sources that every program needs
    sources = {
        "isocharge_model.h": model_header(metadata, network),
        "isocharge_model.c": model_source(metadata, network),
        "isocharge_device.h": device_header(device, metadata.electrodes, has_any_sign=metadata.has_any_sign),
    }
    for name in ("isocharge_chain.h", "isocharge_chain.c", "isocharge_frames.h", "isocharge_frames.c"):
        sources[name] = source_text(name)

    # The README contains the command between backticks, so the command itself must not contain any.
    command_in_one_line = " ".join(command.replace("`", "'").split())
    files = {
        **sources,
        "host_example.c": source_text("host_example.c"),
        "self_test.c": self_test(loaded.golden, metadata),
        "README.md": source_text(
            "README.md",
            label=metadata.label,
            command=command_in_one_line or "isocharge train export-c",
            charges=", ".join(["800.0f"] * n_electrode),
            electrodes=c_comment(", ".join(metadata.electrodes)),
            origin=settings_origin(device),
        ),
    }
    # The Arduino sketch has a folder of its own with copies of the sources. Each electrode has an analogue pin, such as
    # A0. The signal chain of the sketch computes in single precision.
    pins = ", ".join(f"A{index}" for index in range(n_electrode))
    sketch = {
        **sources,
        "isocharge_device.h": SINGLE_PRECISION + sources["isocharge_device.h"],
        "isocharge_sketch.ino": source_text("sketch.ino", pins=pins),
    }
    return files | {f"arduino/isocharge_sketch/{name}": text for name, text in sketch.items()}
