"""The folder of an export: C for the model, the board's signal chain, examples, and a README; whole or not at all."""

from pathlib import Path

from isocharge.common.files import new_folder, refuse_existing, write_whole
from isocharge.serve.live.device import ANY_BOARD, Device
from isocharge.serve.model.model_folder import load_model
from isocharge.train.export_c.c_text import c_comment, source_text
from isocharge.train.export_c.device_header import device_header
from isocharge.train.export_c.model_source import model_header, model_source, self_test
from isocharge.train.export_c.network import read_network

SKETCH = "isocharge_sketch"
"""Name of the Arduino sketch: of its folder and of the file in it."""

FOR_BOARDS = ("isocharge_chain.h", "isocharge_chain.c", "isocharge_frames.h", "isocharge_frames.c")
"""Copied as they are, to the sketch as well."""

SINGLE = "/* This board computes the chain in single precision. */\n#define ISOCHARGE_CHAIN_FLOAT\n\n"


def export_c(model: Path, output: Path, device: Device = ANY_BOARD, *, command: str = "") -> Path:
    """Write a model and the signal chain beside it as C99.

    Args:
        model: The version folder, as `find_model` gives it.
        output: The folder to create.
        device: The board, for the numbers of its signal chain.
        command: How to make this folder again, for its README.

    Returns:
        The folder.

    Raises:
        ModelError: If the model is missing or damaged, or its graph is not one of ours.
        DeviceError: If the device file is for other electrodes.
        OutputExists: If the folder exists.
        OutputError: If the file system refuses; nothing is left then.
    """
    refuse_existing(output)
    files = c_files(model, device, command)
    with new_folder(output) as draft:
        for name, text in files.items():
            (draft / name).parent.mkdir(parents=True, exist_ok=True)
            write_whole(draft / name, text.encode())
    return output


def c_files(model: Path, device: Device = ANY_BOARD, command: str = "") -> dict[str, str]:
    """The texts of an export by their paths in its folder; the errors are those of `export_c`."""
    loaded = load_model(model)
    path, metadata = loaded.folder / "model.onnx", loaded.metadata
    network = read_network(path.read_bytes(), str(path))
    files = {
        "isocharge_model.h": model_header(metadata, network),
        "isocharge_model.c": model_source(metadata, network),
        "isocharge_device.h": device_header(device, metadata.electrodes),
        **{name: source_text(name) for name in (*FOR_BOARDS, "host_example.c")},
        "self_test.c": self_test(loaded.golden),
        "README.md": source_text(
            "README.md",
            label=metadata.label,
            command=" ".join(command.replace("`", "'").split()) or "isocharge train export-c",
            charges=", ".join(["800.0f"] * len(metadata.electrodes)),
            electrodes=c_comment(", ".join(metadata.electrodes)),
            board=c_comment(device.name),
        ),
    }
    sketch = {name: files[name] for name in ("isocharge_model.h", "isocharge_model.c", *FOR_BOARDS)}
    sketch["isocharge_device.h"] = SINGLE + files["isocharge_device.h"]
    pins = ", ".join(f"A{number}" for number in range(len(metadata.electrodes)))
    sketch[f"{SKETCH}.ino"] = source_text("sketch.ino", pins=pins)
    return files | {f"arduino/{SKETCH}/{name}": text for name, text in sketch.items()}
