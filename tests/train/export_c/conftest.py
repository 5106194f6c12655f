"""An export, compiled and called through ctypes."""

import ctypes
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from isocharge.serve import find_model
from isocharge.serve.live.device import ANY_BOARD
from isocharge.train.export_c.folder import export_c

HERE = Path(__file__).parent
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")


def compile_strictly(compiler, folder, output, *sources, options=("-O2",)):
    """Compile sources of an export strictly; skips if the compiler is not installed."""
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    command = [compiler, *STRICT, *options, "-I", str(folder), "-o", str(output), *map(str, sources), "-lm"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return output


@dataclass(frozen=True)
class Exported:
    """A compiled export of a model and a board."""

    library: ctypes.CDLL
    electrodes: int
    numbers: int
    source: str

    def predict(self, charge_pC):
        """Contacts, shape (n, 10), or (n, 7) of a model without correlations."""
        charges = np.ascontiguousarray(charge_pC, dtype=np.float32)
        contacts = np.empty((len(charges), self.numbers), np.float32)
        self.library.bridge_predict(_of(charges), len(charges), 1, _of(contacts))
        return contacts

    def chain(self, values, t_s, dt_s, limited=None, tare=None):
        """Touch charges, tares, contact and flags of frames, one row each."""
        n = len(values)
        values, t_s, dt_s = (np.ascontiguousarray(given, dtype=float) for given in (values, t_s, dt_s))
        marks = [np.zeros(n, np.int32) if given is None else np.int32(given) for given in (limited, tare)]
        charge = np.empty_like(values)
        base = np.empty_like(values)
        contact = np.empty(n, np.int32)
        flags = np.empty(n, np.uint32)
        arrays = [values, t_s, dt_s, *marks]
        self.library.bridge_chain(*map(_of, arrays), n, *map(_of, (charge, base, contact, flags)))
        return charge, base, contact, flags

    def frames(self, data):
        """Frames in bytes as (seq, t_us, flags, values), and the counters."""
        counts = (ctypes.c_ulong * 4)()
        most = len(data) // 12 + 1
        head = np.empty((most, 4), np.uint32)
        values = np.empty((most, 255), np.float32)
        n = self.library.bridge_frames(data, len(data), counts, _of(head), _of(values))
        frames = [
            (int(row[0]), int(row[1]), int(row[3]), tuple(numbers[: row[2]].tolist()))
            for row, numbers in zip(head[:n], values[:n], strict=True)
        ]
        return frames, tuple(counts)

    def encode(self, seq, t_us, flags, values):
        """The bytes of a frame."""
        charges = np.array(values, dtype=np.float32)
        data = ctypes.create_string_buffer(2000)
        size = self.library.bridge_encode(seq, ctypes.c_uint32(t_us), len(values), flags, _of(charges), data)
        return data.raw[:size]

    def clock(self, t_us):
        """Clock and steps, s."""
        ticks = np.array(t_us, dtype=np.uint32)
        t_s = np.empty(len(ticks))
        dt_s = np.empty(len(ticks))
        self.library.bridge_clock(_of(ticks), len(ticks), _of(t_s), _of(dt_s))
        return t_s, dt_s


@pytest.fixture(scope="session")
def build(tmp_path_factory):
    """Exports a model for a board and compiles it: `build(model, device, options)`; the same network only once."""
    networks = {}

    def build(model, device=ANY_BOARD, options=("-O2",), compiler="gcc"):
        folder = export_c(find_model(model), tmp_path_factory.mktemp("c") / "export", device)
        if (model, compiler, options) not in networks:
            words = (*options, "-fPIC", "-c")
            networks[model, compiler, options] = compile_strictly(
                compiler, folder, folder / "network.o", "isocharge_model.c", options=words
            )
        parts = (HERE / "bridge.c", "isocharge_chain.c", "isocharge_frames.c", networks[model, compiler, options])
        library = compile_strictly(
            compiler, folder, folder / "bridge.so", *parts, options=(*options, "-fPIC", "-shared")
        )
        header, source = ((folder / f"isocharge_model.{kind}").read_text() for kind in ("h", "c"))
        sizes = (int(header.split(f"ISOCHARGE_{name} ")[1].split()[0]) for name in ("ELECTRODES", "CONTACT_NUMBERS"))
        return Exported(ctypes.CDLL(str(library)), *sizes, source)

    return build


@pytest.fixture(scope="session")
def compile_c():
    """The function that compiles sources of an export strictly."""
    return compile_strictly


@pytest.fixture(scope="session")
def exports(tmp_path_factory):
    """Exports of a model with three and of one with four electrodes, for no special board."""
    folder = tmp_path_factory.mktemp("exports")
    return [export_c(find_model(name), folder / name) for name in ("three-25um-biaxial", "four-25um-biaxial-films")]


def _of(array):
    return array.ctypes.data_as(ctypes.c_void_p)
