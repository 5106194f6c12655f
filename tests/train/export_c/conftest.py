"""Fixtures that export models to C, compile them, and call them through ctypes."""

import ctypes
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from isocharge.serve import Contact, find_model, load_model
from isocharge.serve.live.device import ANY_BOARD
from isocharge.serve.signal_chain.stage import Device
from isocharge.train.export_c.folder import export_c
from processes import finished

HERE = Path(__file__).parent
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror", "-pedantic")


def compile_strictly(compiler, folder, output, *sources, options=("-O0",)):
    """Compile sources of an export with all warnings as errors, and return the output file.

    If the compiler is not installed, the test is skipped.
    """
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    command = [compiler, *STRICT, *options, "-I", str(folder), "-o", str(output), *map(str, sources), "-lm"]
    completed = finished(command, cwd=folder)
    assert completed.returncode == 0, completed.stderr
    return output


@dataclass(frozen=True)
class Exported:
    """A compiled export of a model and a board. `bridge.c` defines the functions of the library.

    Attributes:
        library: The shared library.
        electrodes: Number of electrodes.
        source: Text of `isocharge_model.c`.
        device: The board.
    """

    library: ctypes.CDLL
    electrodes: int
    source: str
    device: Device

    def predict(self, charge_pC):
        """Return contacts, shape (n, 10), from charges of shape (n, electrodes), pC."""
        charges = np.ascontiguousarray(charge_pC, dtype=np.float32)
        contacts = np.empty((len(charges), len(Contact._fields)), np.float32)
        self.library.bridge_predict(_pointer(charges), len(charges), 1, _pointer(contacts))
        return contacts

    def flags(self, contacts):
        """Return the bits of the flags of contacts, shape (n,), from contacts of shape (n, 7)."""
        rows = np.ascontiguousarray(contacts, dtype=np.float32)
        flags = np.empty(len(rows), np.uint32)
        self.library.bridge_flags(_pointer(rows), len(rows), _pointer(flags))
        return flags

    def chain(self, values, t_s, dt_s, limited, tare):
        """Process frames with the signal chain.

        Args:
            values: Values of the frames, shape (n, electrodes).
            t_s: Times of the frames, shape (n,), s.
            dt_s: Times since the previous frame, shape (n,), s.
            limited: Whether each frame is limited, shape (n,).
            tare: Whether to measure the tare again at each frame, shape (n,).

        Returns:
            Touch charges, tares, shape (n, electrodes) each, contact states and flags, shape (n,) each.
        """
        count = len(values)
        columns = [np.ascontiguousarray(column, dtype=float) for column in (values, t_s, dt_s)]
        inputs = [*columns, np.int32(limited), np.int32(tare)]
        charge = np.empty((count, self.electrodes))
        tare_charge = np.empty_like(charge)
        contact = np.empty(count, np.int32)
        flags = np.empty(count, np.uint32)
        outputs = [charge, tare_charge, contact, flags]
        self.library.bridge_chain(*map(_pointer, inputs), count, *map(_pointer, outputs))
        return charge, tare_charge, contact, flags

    def frames(self, data):
        """Parse bytes.

        Returns:
            The frames as (seq, t_us, flags, values), and the counters of the parser.
        """
        counts = (ctypes.c_ulong * 4)()
        max_count = len(data) // 12 + 1
        heads = np.empty((max_count, 4), np.uint32)
        values = np.empty((max_count, 255), np.float32)
        count = self.library.bridge_frames(data, len(data), counts, _pointer(heads), _pointer(values))
        frames = []
        for (seq, t_us, n_value, flags), frame_values in zip(heads[:count].tolist(), values[:count], strict=True):
            frames.append((seq, t_us, flags, tuple(frame_values[:n_value].tolist())))
        return frames, tuple(counts)

    def encode(self, frame):
        """Return the bytes of a frame."""
        charges = np.array(frame.values, dtype=np.float32)
        data = ctypes.create_string_buffer(2000)
        size = self.library.bridge_encode(
            frame.seq, ctypes.c_uint32(frame.t_us), len(charges), frame.bits, _pointer(charges), data
        )
        return data.raw[:size]

    def clock(self, t_us):
        """Return the times and the steps of a clock, s, from time stamps of a board, us."""
        ticks = np.array(t_us, dtype=np.uint32)
        t_s = np.empty(len(ticks))
        dt_s = np.empty(len(ticks))
        self.library.bridge_clock(_pointer(ticks), len(ticks), _pointer(t_s), _pointer(dt_s))
        return t_s, dt_s


@pytest.fixture(scope="session")
def build(tmp_path_factory):
    """A function that exports a model for a board and compiles it. Each network is compiled only once."""
    networks = {}

    def build(model, device=ANY_BOARD, options=("-O0",), compiler="gcc"):
        folder = export_c(find_model(model), tmp_path_factory.mktemp("c") / "export", device)
        key = (model, compiler, options)
        if key not in networks:
            object_file = folder / "network.o"
            object_options = (*options, "-fPIC", "-c")
            networks[key] = compile_strictly(compiler, folder, object_file, "isocharge_model.c", options=object_options)
        sources = (HERE / "bridge.c", networks[key])
        library_options = (*options, "-fPIC", "-shared")
        library = compile_strictly(compiler, folder, folder / "bridge.so", *sources, options=library_options)
        return Exported(
            library=ctypes.CDLL(str(library)),
            electrodes=len(load_model(find_model(model)).metadata.electrodes),
            source=(folder / "isocharge_model.c").read_text(),
            device=device,
        )

    return build


@pytest.fixture(scope="session")
def compile_c():
    """The function `compile_strictly`."""
    return compile_strictly


@pytest.fixture(scope="session")
def exports(tmp_path_factory):
    """Exports of a small model with three and of one with four electrodes, for no special board."""
    folder = tmp_path_factory.mktemp("exports")
    return [export_c(find_model(name), folder / name) for name in ("three-25um-biaxial-student", "four-25um-biaxial")]


def _pointer(array):
    """Return a pointer to the data of an array."""
    return array.ctypes.data_as(ctypes.c_void_p)
