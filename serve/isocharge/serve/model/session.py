"""Functions that open, check and run the ONNX session of a model, and golden vectors that test its outputs.

The network of a model takes microseconds to run. A session therefore uses one thread, because a second thread would
cost more time than it saves. Between two runs, the session sleeps. By default, onnxruntime would wait actively, and a
stream of 100 frames per second would keep most of a processor core busy. `BoundPress` is the fastest way to compute one
press, because its memory for input and output is bound to the session only once.

Golden vectors are input charges and the outputs that the model computed for these charges when it was exported. The
file `golden.json` stores the golden vectors and the checksum of `model.onnx`. The checksum shows whether `model.onnx`
is still the released file. A comparison with the stored outputs shows whether another machine or another version of
onnxruntime computes the same outputs. A computed output a agrees with a stored output b if

    |a - b| <= 1e-5 max(|b|, floor),

where the floor is a constant for each column of the output.
"""

import math
import struct
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import onnxruntime as ort
from msgspec import Meta, Struct, json

from isocharge.common.arrays import Singles
from isocharge.common.errors import ModelError, cut, error_context
from isocharge.common.files import sha256_of
from isocharge.common.structs import Finite, NotNegative, Text, read_json
from isocharge.serve.model.contact import CORRELATION_COLUMNS, STD_COLUMNS
from isocharge.serve.model.metadata import ModelMetadata

GRAPH_FILE = "model.onnx"
"""Name of the file of a model in its version folder."""

INPUT = "charge_pC"
"""Name of the input."""

CORRELATION = "contact_correlation"
"""Name of the output with the correlations, which come last in a `Contact`."""

OUTPUTS = {"contact": 3, "contact_std": 3, CORRELATION: 3, "misfit": 1}
"""Names of the outputs and their numbers of columns. `isocharge.serve.model.contact.Contact` describes the columns."""

COLUMNS = {
    "contact": slice(0, 3),
    "contact_std": STD_COLUMNS,
    "misfit": slice(6, 7),
    CORRELATION: CORRELATION_COLUMNS,
}
"""Columns of each output among the ten values of a `Contact`."""

EXTERNAL_DATA = b"\x0a\x08location"
"""Encoded key of an entry of an ONNX tensor. The entry names the file that contains the numbers of the tensor."""


def open_session(onnx_model: bytes, where: str) -> ort.InferenceSession:
    """Open a session of a model that uses one thread.

    This function does not check the inputs and outputs of the model. Use `check_interface` for this check.

    Args:
        onnx_model: Content of `model.onnx`.
        where: Name or file of the model, for error messages.

    Raises:
        ModelError: If the bytes are not an ONNX graph that onnxruntime can run, or if the graph loads external data.
    """
    if EXTERNAL_DATA in onnx_model:  # the bytes of the key that names an external file
        raise ModelError(
            f"{where}: expected a model with all of its numbers inside, got one that loads external data from another "
            "file, which no checksum covers; save the model again with onnx.save(model, path, "
            "save_as_external_data=False)"
        )
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1  # starts no other threads
    try:
        session = ort.InferenceSession(onnx_model, options, providers=["CPUExecutionProvider"])
        # Read all texts, because onnxruntime raises an exception when a text that is not valid UTF-8 is read.
        _ = session.get_modelmeta().custom_metadata_map
        _ = [tensor.name for tensor in (*session.get_inputs(), *session.get_outputs())]
        return session
    except Exception as error:  # onnxruntime's exceptions have no common base class of their own
        raise ModelError(
            f"{where}: onnxruntime {ort.__version__} cannot read these {len(onnx_model)} bytes as a model "
            f"({cut(str(error))}); copy or export it again"
        ) from error


def run(session: ort.InferenceSession, charge_pC: Singles) -> dict[str, Singles]:
    """Compute the outputs of a model for a batch of presses.

    Args:
        session: Session of the model.
        charge_pC: Charges, shape (n, electrodes), pC.

    Returns:
        Outputs by name in the order of `OUTPUTS`, each of shape (n, width). `OUTPUTS` contains the width of each.

    Raises:
        ModelError: If onnxruntime cannot run the graph on these charges, or an output has another shape than the graph
            declares.
    """
    try:
        outputs = dict(zip(OUTPUTS, session.run(tuple(OUTPUTS), {INPUT: charge_pC}), strict=True))
        for name, width in OUTPUTS.items():
            if outputs[name].shape != (len(charge_pC), width):
                raise ValueError(f"{name} has the shape {outputs[name].shape}")  # becomes a ModelError below
    except Exception as error:  # onnxruntime's exceptions have no common base class of their own
        raise ModelError(
            f"the model's graph fails when it is run ({cut(str(error))}); copy or export it again"
        ) from error
    return outputs


def check_interface(session: ort.InferenceSession, n_electrode: int, where: str) -> None:
    """Check that the input and the outputs of a model have the required names, number types and shapes.

    The number of presses in a batch must be variable.

    Args:
        session: Session of the model.
        n_electrode: Number of electrodes of the model.
        where: Name or file of the model, for error messages.

    Raises:
        ModelError: If the input or an output is missing or not as required, or if the model has an additional input or
            output.
    """
    widths = {INPUT: n_electrode} | OUTPUTS
    expected = {name: ("tensor(float)", ["n", width]) for name, width in widths.items()}
    actual = {
        tensor.name: (tensor.type, [size if isinstance(size, int) else "n" for size in tensor.shape])  # "n" is variable
        for tensor in (*session.get_inputs(), *session.get_outputs())
    }
    if actual != expected:
        raise ModelError(
            f"{where}: expected the tensors {expected}, got {actual}; this is not a model of isocharge, or one of "
            "another version"
        )


class BoundPress:
    """Memory for the input and the outputs of one press, which is bound to a session.

    Attributes:
        write: Function that stores charges, pC, which are passed as separate arguments.
        run: Function that computes the outputs from the stored charges.
        read: Function that returns the ten computed values in the order of a `Contact`.
    """

    def __init__(self, session: ort.InferenceSession, n_electrode: int) -> None:
        """Allocate the memory of one press, and bind it to a session.

        Args:
            session: Session of the model.
            n_electrode: Number of electrodes.
        """
        charges = np.zeros((1, n_electrode), dtype=np.float32)
        values = np.zeros(sum(OUTPUTS.values()), dtype=np.float32)  # the ten values of a `Contact`

        # Bind the charges, and each output to its columns of the values. The session stores only the addresses of the
        # arrays. The memoryviews below keep the arrays alive.
        binding = session.io_binding()
        binding.bind_input(INPUT, "cpu", 0, np.float32, charges.shape, charges.ctypes.data)
        for name, columns in COLUMNS.items():
            output = values[np.newaxis, columns]  # a view of shape (1, number of columns), not a copy
            binding.bind_output(name, "cpu", 0, np.float32, output.shape, output.ctypes.data)
        self.run: Callable[[], None] = partial(session.run_with_iobinding, binding)

        # Functions that write float32 numbers into the memory of the charges, and read the numbers of the outputs. This
        # memory is passed as a memoryview of bytes.
        self.write = partial(struct.Struct(f"={n_electrode}f").pack_into, charges.data.cast("B"), 0)  # from byte 0 on
        self.read = partial(struct.Struct(f"={values.size}f").unpack, values.data.cast("B"))

        # Memoryviews of the same arrays for `run_into`, which copies whole arrays. The type is Any, because the type
        # hints of memoryview cover only bytes.
        self._charge_view: Any = charges[0].data
        self._value_view: Any = values.data

    def run_into(self, charge_pC: Singles, out: Singles) -> None:
        """Compute one press. The charges are read from one array, and the results are written into another array.

        The arrays are copied through memoryviews, which check the number type and the shape without extra time.

        Args:
            charge_pC: Charges, shape (electrodes,), float32, pC.
            out: Array that receives the values, shape (10,), float32.

        Raises:
            AttributeError, NotImplementedError, TypeError, ValueError: If an array does not have the number type and
                shape of the bound memory. Nothing is written into `out` in this case.
        """
        self._charge_view[:] = charge_pC
        self.run()  # reads the charges from their memory, and writes the outputs into the memory of `_value_view`
        target: Any = out.data
        target[:] = self._value_view


RELATIVE_TOLERANCE = 1e-5
"""Largest difference of two outputs, relative to max(|output|, floor), dimensionless."""

FLOORS = {
    "contact": (1.0, 1.0, 0.1),  # mm, mm, N
    "contact_std": (1.0, 1.0, 0.1),
    # A correlation is computed from terms that nearly cancel. Versions of onnxruntime differ by 1e-4.
    CORRELATION: (10.0, 10.0, 10.0),
    # Near zero, the misfit is computed from terms that nearly cancel. Versions of onnxruntime differ by 1e-4.
    "misfit": (20.0,),
}
"""Floor for each column of an output, in the unit of the column. Below the floor, the tolerance is constant."""

RANGE_SHARE = 0.05
"""Floor of x, y and the force, relative to the range of the model, unless the floor in `FLOORS` is larger."""


def contact_floors(metadata: ModelMetadata) -> tuple[float, float, float]:
    """Return the floors of x (mm), y (mm) and the force (N) for the outputs `contact` and `contact_std` of a model.

    A computed output may differ from the stored output by a tolerance, which is proportional to the magnitude of the
    output. Below the floor, the tolerance is constant. The floors of x and y are at least the rms position error of the
    model.

    Args:
        metadata: Metadata of the model.
    """
    position_floor_mm, _, force_floor_N = FLOORS["contact"]  # smallest floors of x, y (the same as of x) and the force
    radius_mm = max(math.hypot(x_mm, y_mm) for x_mm, y_mm in metadata.working_area_mm)
    position_rms_mm = metadata.errors.get("position_rms_mm", 0.0)
    _min_force_N, max_force_N = metadata.force_range_N
    # `RANGE_SHARE` is the floor relative to the range of positions or forces.
    position_floor_mm = max(position_floor_mm, RANGE_SHARE * radius_mm, position_rms_mm)
    return position_floor_mm, position_floor_mm, max(force_floor_N, RANGE_SHARE * max_force_N)


Rows = Annotated[list[list[Finite]], Meta(min_length=1)]
"""Rows of numbers, one for each press."""


class Tolerance(Struct, frozen=True):
    """Largest accepted differences of outputs, which are the object `tolerance` of `golden.json`.

    Attributes:
        relative: Largest difference of two outputs, relative to max(|output|, floor).
        floor: Floor for each column of an output, by the name of the output.
        rule: Formula of the comparison, for readers of the file.
    """

    relative: NotNegative
    floor: dict[str, tuple[Finite, ...]]
    rule: str = "|a - b| <= relative * max(|b|, floor)"


class Golden(Struct, frozen=True):
    """Golden vectors of one model, which are the content of `golden.json`.

    Attributes:
        sha256: Checksum of the model file.
        tolerance: Largest accepted differences of outputs.
        inputs: Rows of input charges, pC, by the name of the input.
        outputs: Rows of outputs by name.
        files: Checksums of the files that lie beside the model, such as `charges.npz`, by file name.
    """

    sha256: Text
    tolerance: Tolerance
    inputs: dict[str, Rows]
    outputs: dict[str, Rows]
    files: dict[Text, Text]

    @property
    def checksums(self) -> dict[str, str]:
        """Checksums of the model file and of the files beside it, by file name."""
        return {GRAPH_FILE: self.sha256} | self.files

    @property
    def charge_pC(self) -> Singles:
        """Input charges, shape (n, electrodes), pC. A charge beyond the range of float32 is infinite."""
        with np.errstate(over="ignore"):
            return np.array(self.inputs[INPUT], np.float32)

    def to_json(self) -> bytes:
        """Return the content of `golden.json`."""
        return json.format(json.encode(self), indent=1) + b"\n"


def make_golden(
    session: ort.InferenceSession,
    onnx_model: bytes,
    charge_pC: Singles,
    contact_floor: tuple[float, float, float],
    companion_files: Mapping[str, bytes],
) -> Golden:
    """Compute the golden vectors of a new model, which are the given charges and the outputs for these charges.

    Args:
        session: Session of the model.
        onnx_model: Content of `model.onnx`, whose checksum is stored.
        charge_pC: Input charges, shape (n, electrodes), pC.
        contact_floor: Floors of x (mm), y (mm) and the force (N) for the comparison of outputs, from `contact_floors`.
        companion_files: Contents of companion files by file name, whose checksums are stored.

    Raises:
        ModelError: If an output is not finite.
    """
    outputs = run(session, charge_pC)
    for name, rows in outputs.items():
        is_finite = np.isfinite(rows).all(axis=1)  # shape (n,)
        if not is_finite.all():
            raise ModelError(
                f"the new model: {name}: expected finite outputs, got {rows[~is_finite][0]} for the charges "
                f"{charge_pC[~is_finite][0]} pC"
            )
    # `FLOORS` contains the floors of each output by its name. The floors of two outputs depend on the model.
    return Golden(
        sha256=sha256_of(onnx_model),
        tolerance=Tolerance(RELATIVE_TOLERANCE, FLOORS | {"contact": contact_floor, "contact_std": contact_floor}),
        inputs={INPUT: charge_pC.tolist()},
        outputs={name: rows.tolist() for name, rows in outputs.items()},
        files={name: sha256_of(content) for name, content in companion_files.items()},
    )


def read_golden(path: Path) -> Golden:
    """Read the golden vectors of a model (input charges and stored outputs) from the file `golden.json`.

    Raises:
        ModelError: If the file is missing or damaged.
    """
    with error_context(ModelError, after="; the file is damaged or missing: copy or export the model again"):
        golden = read_json(path, "golden vectors", ModelError, Golden)
        try:
            _check_sizes(golden)
        except (ValueError, KeyError) as error:  # a KeyError if an output or its floors are missing
            raise ModelError(f"{path}: {error}") from error
    return golden


def _check_sizes(golden: Golden) -> None:
    """Check that each stored output has one row for each press, and one number and one floor for each of its columns.

    The floor of a column is the magnitude below which the tolerance of its numbers is constant instead of proportional
    to the number.

    Raises:
        ValueError: If an output has another size, or rows of different lengths.
        KeyError: If an output or its floors are missing.
    """
    n_press = len(golden.charge_pC)
    for name, column_count in OUTPUTS.items():
        actual_shape = np.shape(golden.outputs[name])
        floor_count = len(golden.tolerance.floor[name])
        if actual_shape != (n_press, column_count) or floor_count != column_count:
            raise ValueError(
                f"{name}: expected {n_press} rows of {column_count} numbers, and {column_count} floors, got an array "
                f"of shape {actual_shape} and {floor_count} floors"
            )
