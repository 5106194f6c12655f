"""Functions that open, check and run the ONNX session of a model, and convert charges to the inputs of the session.

The network of a model takes microseconds to run. A session therefore uses one thread, because a second thread would
cost more time than it saves. Between two runs, the session sleeps. By default, onnxruntime would wait actively, and a
stream of 100 frames per second would keep most of a processor core busy. `BoundPress` is the fastest way to compute one
press, because its memory for input and output is bound to the session only once.

Charges must be finite numbers in the order of the electrodes. `write_finite` is a fast check for plain numbers, and
`as_float32` for arrays. If a fast check fails, the charges are checked one by one in order to name the electrode in the
error message.
"""

import math
import struct
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import ArrayLike, NDArray

from isocharge.common.arrays import Singles
from isocharge.common.errors import ChargeError, ModelError, cut

INPUT = "charge_pC"
"""Name of the input."""

CORRELATION = "contact_correlation"
"""Name of the output that older models do not have."""

OUTPUTS = {"contact": 3, "contact_std": 3, CORRELATION: 3, "misfit": 1}
"""Names of the outputs and their numbers of columns. `OUTPUT_MEANINGS` describes the columns."""

EXTERNAL_DATA = b"\x0a\x08location"
"""Encoded key of the entry of an ONNX tensor that names the file with the numbers of the tensor."""

OUTPUT_MEANINGS = {
    "contact": "x_mm, y_mm, force_N: position (mm) and force (N, positive when the probe pushes)",
    "contact_std": "one standard deviation of x (mm), y (mm) and the force (N)",
    CORRELATION: "correlations of the errors, from -1 to 1: x with y, x with the force, y with the force",
    "misfit": "distance of the charges from the nearest single contact, in standard deviations of the noise",
}
"""Columns of each output with their units. The rows of each output are the presses."""


def output_widths(session: ort.InferenceSession) -> dict[str, int]:
    """Return a dictionary from the name of each output of a model to its number of columns, in the order of `OUTPUTS`.

    Outputs that `OUTPUTS` does not contain are left out.
    """
    output_names = {tensor.name for tensor in session.get_outputs()}
    return {name: width for name, width in OUTPUTS.items() if name in output_names}


def open_session(
    onnx_model: bytes, where: str, constants: Mapping[str, Singles] = MappingProxyType({})
) -> ort.InferenceSession:
    """Open a session of a model that uses one thread.

    This function does not check the inputs and outputs of the model. Use `check_interface` for this check.

    Args:
        onnx_model: Content of `model.onnx`.
        where: Name or file of the model, for error messages.
        constants: Arrays that replace constants of the graph, by the names of the constants. The session uses the
            memory of the arrays. The arrays must therefore not be changed afterwards.

    Raises:
        ModelError: If the bytes are not an ONNX graph that onnxruntime can run, or if the graph loads external data.
    """
    if EXTERNAL_DATA in onnx_model:
        raise ModelError(
            f"{where}: expected a model with all of its numbers inside, got one that loads external data from another "
            "file, which no checksum covers; save the model again with onnx.save(model, path, "
            "save_as_external_data=False)"
        )
    options = _single_thread_options()
    try:
        # In onnxruntime, the constants of a graph are called "initializers".
        initializers = {name: ort.OrtValue.ortvalue_from_numpy(values) for name, values in constants.items()}
        for name, initializer in initializers.items():
            options.add_initializer(name, initializer)
        session = ort.InferenceSession(onnx_model, options, providers=["CPUExecutionProvider"])
        _check_texts(session)
        return session
    except Exception as error:  # onnxruntime's exceptions have no common base class of their own
        raise ModelError(
            f"{where}: onnxruntime {ort.__version__} cannot read these {len(onnx_model)} bytes as a model "
            f"({cut(str(error))}); copy or export it again"
        ) from error


def _check_texts(session: ort.InferenceSession) -> None:
    """Check that the metadata and the names of the tensors of a session are valid UTF-8.

    The function only reads the texts and discards them, because onnxruntime raises an exception when a text that is not
    valid is read.
    """
    _ = session.get_modelmeta().custom_metadata_map
    _ = [tensor.name for tensor in (*session.get_inputs(), *session.get_outputs())]


def _single_thread_options() -> ort.SessionOptions:
    """Return the options of a session that computes in the calling thread and starts no other threads."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    # A spinning thread would keep a processor core busy while it waits for work.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    return options


def run(session: ort.InferenceSession, charge_pC: Singles, names: Sequence[str] | None = None) -> dict[str, Singles]:
    """Compute the outputs of a model for a batch of presses.

    Args:
        session: Session of the model.
        charge_pC: Charges, shape (n, electrodes), pC.
        names: Names of the requested outputs; all outputs by default.

    Returns:
        The requested outputs by name, each of shape (n, width).

    Raises:
        ModelError: If onnxruntime cannot run the graph on these charges.
    """
    names = tuple(output_widths(session)) if names is None else names
    try:
        return dict(zip(names, session.run(names, {INPUT: charge_pC}), strict=True))
    except Exception as error:  # onnxruntime's exceptions have no common base class of their own
        raise run_error(error) from error


def run_error(error: Exception) -> ModelError:
    """Return the error for a graph that onnxruntime can read but cannot run."""
    return ModelError(f"the model's graph fails when it is run ({cut(str(error))}); copy or export it again")


def check_output_shapes(outputs: Mapping[str, Singles], count: int, where: str) -> None:
    """Check the shapes of computed outputs, which may differ from the shapes that the graph declares.

    Args:
        outputs: Computed outputs by name.
        count: Number of presses.
        where: Name or file of the model, for error messages.

    Raises:
        ModelError: If an output does not have one row of the right width for each press.
    """
    for name, rows in outputs.items():
        expected_shape = (count, OUTPUTS[name])
        if rows.shape != expected_shape:
            raise ModelError(
                f"{where}: {name}: expected an output of shape {expected_shape}, got {rows.shape}; "
                "copy or export the model again"
            )


def check_interface(session: ort.InferenceSession, n_electrode: int, where: str) -> None:
    """Check that the input and the outputs of a model have the required names, number types and shapes.

    The number of presses in a batch must be variable.

    Args:
        session: Session of the model.
        n_electrode: Number of electrodes of the model.
        where: Name or file of the model, for error messages.

    Raises:
        ModelError: If the input or an output is not as required.
    """
    # Older models compute no correlations. This output is therefore expected only if the model has it.
    required_outputs = {name: width for name, width in OUTPUTS.items() if name != CORRELATION}
    expected_outputs = required_outputs | output_widths(session)
    _check_tensors("input", session.get_inputs(), {INPUT: n_electrode}, where)
    _check_tensors("outputs", session.get_outputs(), expected_outputs, where)


def _check_tensors(role: str, tensors: list[ort.NodeArg], widths: dict[str, int], where: str) -> None:
    """Check that the inputs or the outputs of a graph have the expected names, number types and widths.

    Args:
        role: "input" or "outputs", for error messages.
        tensors: The inputs or the outputs of the graph.
        widths: Expected width of each tensor by its name.
        where: Name or file of the model, for error messages.

    Raises:
        ModelError: If a tensor is missing, has another number type or width, or is not expected.
    """
    expected = {name: ("tensor(float)", width) for name, width in widths.items()}
    actual = {tensor.name: (tensor.type, _row_width(tensor.shape)) for tensor in tensors}
    if actual != expected:
        raise ModelError(
            f"{where}: expected the {role} {_describe_tensors(expected)}, got {_describe_tensors(actual)}; "
            "this is not a model of isocharge, or one of another version"
        )


def _row_width(shape: list[int | str | None]) -> object:
    """Return the width of a tensor of shape [n, width] with a variable n.

    For any other shape, return the whole shape. A shape never equals an expected width, so the comparison fails.
    """
    is_batch = len(shape) == 2 and not isinstance(shape[0], int)  # a variable size is a name or None
    return shape[1] if is_batch else shape


def _describe_tensors(tensors: Mapping[str, tuple[str, object]]) -> str:
    """Format the names, number types and widths of tensors for an error message."""
    return ", ".join(f"{name} {number_type} [n, {width}]" for name, (number_type, width) in tensors.items())


N_WITHOUT_CORRELATION = 7
"""Number of values of a `Contact` before its correlations, which come last."""


class BoundPress:
    """Memory for the input and the outputs of one press, which is bound to a session.

    Attributes:
        write: Function that stores charges, pC, which are passed as separate arguments.
        run: Function that computes the outputs from the stored charges.
        read: Function that returns the computed values in the order of a `Contact`.
        size: Number of values that `read` returns: ten, or seven if the model computes no correlations.
        columns: Slice of each output in these values, by the name of the output.
        outputs: Views of the computed values, each of shape (1, width), by the name of the output. The next press
            changes their values.
    """

    def __init__(self, session: ort.InferenceSession, n_electrode: int) -> None:
        """Allocate the memory of one press, and bind it to a session.

        Args:
            session: Session of the model.
            n_electrode: Number of electrodes.
        """
        charges = np.zeros((1, n_electrode), dtype=np.float32)
        self.columns = _output_columns(output_widths(session))  # slice of each output, by the name of the output
        self.size = max(columns.stop for columns in self.columns.values())
        outputs = np.zeros(self.size, dtype=np.float32)
        self.outputs = {name: outputs[np.newaxis, columns] for name, columns in self.columns.items()}
        # The session stores only the addresses of the arrays. The views in `write` and `read` keep the arrays alive.
        binding = _bind(session, charges, outputs, self.columns)
        self.run: Callable[[], None] = partial(session.run_with_iobinding, binding)

        # Functions that write float32 numbers into the memory of the charges, and read the numbers of the outputs
        charge_format = struct.Struct(f"={n_electrode}f")
        output_format = struct.Struct(f"={outputs.size}f")
        self.write = partial(charge_format.pack_into, charges.data.cast("B"), 0)  # begins at byte 0
        self.read = partial(output_format.unpack, outputs.data.cast("B"))
        # The type is Any because the type hints of memoryview cover only bytes.
        self._charge_view: Any = charges[0].data
        self._output_view: Any = outputs.data
        self._output_view_without_correlation: Any = outputs[:N_WITHOUT_CORRELATION].data

    def run_into(self, charge_pC: Singles, out: Singles) -> None:
        """Compute one press. The charges are read from one array, and the results are written into another array.

        The arrays are copied through memoryviews, which check the number type and the shape without extra time.

        Args:
            charge_pC: Charges, shape (electrodes,), float32, pC.
            out: Array that receives the values, shape (size,), float32; or shape (7,) to leave out the correlations.

        Raises:
            AttributeError, NotImplementedError, TypeError, ValueError: If an array does not have the number type and
                shape of the bound memory. Nothing is written into `out` in this case.
        """
        self._charge_view[:] = charge_pC
        self.run()  # reads the charges from their memory, and writes the outputs into the memory of `_output_view`
        target: Any = out.data
        if len(target) == N_WITHOUT_CORRELATION:
            target[:] = self._output_view_without_correlation
        else:
            target[:] = self._output_view


def _output_columns(widths: Mapping[str, int]) -> dict[str, slice]:
    """Return the slice that each output of a model occupies in the values of a `Contact`.

    Args:
        widths: Number of values of each output by its name.

    Returns:
        Slice of each output, by the name of the output. The slices follow each other in the order of `widths`, but the
        slice of the correlations comes last, because the correlations are the last values of a `Contact`.
    """
    names = [name for name in widths if name != CORRELATION]
    if CORRELATION in widths:
        names.append(CORRELATION)

    columns: dict[str, slice] = {}
    start = 0
    for name in names:
        stop = start + widths[name]
        columns[name] = slice(start, stop)
        start = stop
    return columns


def _bind(
    session: ort.InferenceSession, charges: Singles, outputs: Singles, columns: Mapping[str, slice]
) -> ort.IOBinding:
    """Bind arrays to the input and the outputs of a session, so that the session needs no copies of the arrays.

    Args:
        session: Session of the model.
        charges: Array from which the charges are read, shape (1, electrodes).
        outputs: Array into which all outputs are written, shape (size,).
        columns: Columns of each output in `outputs`, by the name of the output.
    """
    binding = session.io_binding()
    binding.bind_input(INPUT, "cpu", 0, np.float32, charges.shape, charges.ctypes.data)
    for name, output_columns in columns.items():
        width = output_columns.stop - output_columns.start
        binding.bind_output(name, "cpu", 0, np.float32, (1, width), outputs[output_columns].ctypes.data)
    return binding


MAX_FAST_SQUARE_SUM_pC2 = 1e38
"""Sum of squared charges, pC^2, up to which every charge is certainly finite and within the range of float32."""


def write_finite(write: Callable[..., object], values: Iterable[float]) -> bool:
    """Write the charges of one press as float32 numbers, and check that they are finite.

    Args:
        write: Function that takes the numbers as separate arguments and raises the exceptions of `struct.pack_into`.
        values: The numbers, as many as `write` takes.

    Returns:
        True if all numbers were written and are finite. If False, the memory does not contain valid charges.
    """
    try:
        numbers = tuple(values)
        write(*numbers)
        # The sum is not finite if a number is NaN or infinite. Otherwise, the sum is finite, because `write` has
        # refused numbers beyond the range of float32, and their sum is computed in float64.
        return math.isfinite(sum(numbers))
    except (struct.error, TypeError, ValueError, OverflowError):
        return False


def as_press(charge_pC: ArrayLike, electrodes: tuple[str, ...]) -> Singles:
    """Convert the charges of one press to an array of shape (electrodes,), float32, pC.

    Args:
        charge_pC: Charges, pC, in the order of the electrodes.
        electrodes: Names of the electrodes.

    Raises:
        ChargeError: If the number of charges is wrong, or a charge is not finite. The message names the electrode.
    """
    charges = _as_numbers(charge_pC, electrodes)
    if charges.shape != (len(electrodes),):
        raise ChargeError(f"expected {_expected_charges(electrodes)}, got an array of shape {charges.shape}")
    batch_of_one = as_float32(charges[np.newaxis], electrodes, is_single_press=True)
    return np.asarray(batch_of_one[0])


def as_batch(charge_pC: ArrayLike, electrodes: tuple[str, ...]) -> Singles:
    """Convert the charges of n presses to a contiguous array of shape (n, electrodes), float32, pC.

    Args:
        charge_pC: Charges, shape (n, electrodes), pC, with the columns in the order of the electrodes.
        electrodes: Names of the electrodes.

    Raises:
        ChargeError: If the shape is wrong, or a charge is not finite. The message names the electrode and the row.
    """
    charges = _as_numbers(charge_pC, electrodes)
    if charges.ndim != 2 or charges.shape[1] != len(electrodes):
        raise ChargeError(
            f"expected rows of {_expected_charges(electrodes)}, shape (n, {len(electrodes)}), "
            f"got an array of shape {charges.shape}"
        )
    return as_float32(charges, electrodes)


def _expected_charges(electrodes: tuple[str, ...]) -> str:
    """Return the number of charges and the names of the electrodes as text for an error message."""
    return f"{len(electrodes)} charges {electrodes}"


def _as_numbers(charge_pC: ArrayLike, electrodes: tuple[str, ...]) -> NDArray[np.number]:
    """Convert charges to an array of numbers.

    Args:
        charge_pC: Charges of one press or of several presses, pC.
        electrodes: Names of the electrodes, for error messages.

    Raises:
        ChargeError: If the charges are not numbers.
    """
    expected = _expected_charges(electrodes)
    try:
        charges = np.asarray(charge_pC)
    except ValueError as error:  # rows of different lengths
        raise ChargeError(f"expected {expected} in each row, got {charge_pC!r:.200} ({error})") from error
    if charges.dtype.kind not in "fiu":  # neither floats nor signed or unsigned integers
        raise ChargeError(f"expected {expected} as numbers (pC), got {charge_pC!r:.200}")
    return charges


def as_float32(charges: NDArray[Any], electrodes: tuple[str, ...], *, is_single_press: bool = False) -> Singles:
    """Convert charges of any number type to a contiguous float32 array.

    Args:
        charges: Charges, shape (n, electrodes), pC.
        electrodes: Names of the electrodes, for the error message.
        is_single_press: Whether the error message omits the number of the row.

    Raises:
        ChargeError: If a charge is not finite or beyond the range of float32. The message names the electrode.
    """
    if charges.dtype.kind == "f":
        flat = charges.ravel()
        # If the sum of the squares is not too large, all charges are finite and in the range of float32. One sum is
        # faster than a check of each charge.
        square_sum_pC2 = np.vdot(flat, flat)
        if square_sum_pC2 <= MAX_FAST_SQUARE_SUM_pC2:  # false for NaN
            return np.ascontiguousarray(charges, dtype=np.float32)
    return _checked_float32(charges, electrodes, is_single_press)


def _checked_float32(charges: NDArray[np.number], electrodes: tuple[str, ...], is_single_press: bool) -> Singles:
    """Convert charges to float32, and check that each charge is finite.

    Args:
        charges: Charges, shape (n, electrodes), pC.
        electrodes: Names of the electrodes, for the error message.
        is_single_press: Whether the error message omits the number of the row.

    Raises:
        ChargeError: If a charge is not finite in float32. The message names the electrodes of all such charges in the
            first row that contains one.
    """
    with np.errstate(over="ignore"):  # charges beyond the range of float32 become infinite and are refused below
        converted = np.ascontiguousarray(charges, dtype=np.float32)
    rows, columns = np.nonzero(~np.isfinite(converted))
    if not rows.size:
        return converted
    first_row = rows[0]
    bad_columns = columns[rows == first_row]
    bad_charges = [f"{electrodes[column]!r} ({charges[first_row, column]})" for column in bad_columns]
    where = "" if is_single_press else f" in row {first_row} (rows count from 0)"
    raise ChargeError(f"expected finite charges (pC), got{where} for electrode {', '.join(bad_charges)}")
