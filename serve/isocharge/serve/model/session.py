"""What charges a model takes, and how it is run: ONNX sessions of one thread, no spinning, a checked interface.

A network of this size takes microseconds. A second thread costs more than it saves, and onnxruntime's default, to spin
between runs, burns most of a core at 100 Hz. `BoundPress` is the fast way for one press: memory bound once.

Charges are finite numbers, in the order of the electrodes. The hot paths ask `write_finite` for plain numbers and
`as_singles` for arrays; what these do not take is examined number by number, so that the error names the electrode.
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
"""Name of the output that older models have not."""

OUTPUTS = {"contact": 3, "contact_std": 3, CORRELATION: 3, "misfit": 1}
"""Names and widths of the outputs; see `OUTPUT_MEANINGS`."""

OUTPUT_MEANINGS = {
    "contact": "x_mm, y_mm, force_N: position (mm) and force (N, positive when the probe pushes)",
    "contact_std": "one standard deviation of x (mm), y (mm) and the force (N)",
    CORRELATION: "correlations of the errors, from -1 to 1: x with y, x with the force, y with the force",
    "misfit": "distance of the charges from the nearest single contact, in standard deviations of the noise",
}
"""Numbers of each output in their order, with their units. The first dimension of each output is the press."""


def outputs_of(session: ort.InferenceSession) -> dict[str, int]:
    """Names and widths of the outputs that a model has, in the order of `OUTPUTS`."""
    names = {tensor.name for tensor in session.get_outputs()}
    return {name: width for name, width in OUTPUTS.items() if name in names}


def open_session(
    onnx_model: bytes, where: str, constants: Mapping[str, Singles] = MappingProxyType({})
) -> ort.InferenceSession:
    """A session for one thread, whose interface is not checked yet.

    Args:
        onnx_model: The graph.
        where: The model, for messages.
        constants: In the place of the graph's constants of these names.

    Raises:
        ModelError: If the bytes are not an ONNX graph that onnxruntime can run.
    """
    options = _options()
    try:
        held = {name: ort.OrtValue.ortvalue_from_numpy(values) for name, values in constants.items()}
        for name, value in held.items():
            options.add_initializer(name, value)
        session = ort.InferenceSession(onnx_model, options, providers=["CPUExecutionProvider"])
        _ = session.get_modelmeta().custom_metadata_map  # raises here, not later, if it is no text
        _ = [tensor.name for tensor in (*session.get_inputs(), *session.get_outputs())]
        return session
    except Exception as error:  # onnxruntime's exceptions have no common base of their own
        raise ModelError(
            f"{where}: onnxruntime {ort.__version__} cannot read these {len(onnx_model)} bytes as a model "
            f"({cut(str(error))}); copy or export it again"
        ) from error


def _options() -> ort.SessionOptions:
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    return options


def run(session: ort.InferenceSession, charge_pC: Singles, names: Sequence[str] | None = None) -> dict[str, Singles]:
    """Outputs by name, all of them by default, shape (n, width), from charges of shape (n, electrodes), pC.

    Raises:
        ModelError: If the graph cannot be run on them: it is not the model of these charges.
    """
    names = tuple(outputs_of(session)) if names is None else names
    try:
        return dict(zip(names, session.run(names, {INPUT: charge_pC}), strict=True))
    except Exception as error:  # onnxruntime's exceptions have no common base of their own
        raise run_error(error) from error


def run_error(error: Exception) -> ModelError:
    """The error of a graph that was read, and fails when it is run."""
    return ModelError(f"the model's graph fails when it is run ({cut(str(error))}); copy or export it again")


def check_rows(outputs: Mapping[str, Singles], count: int, where: str) -> None:
    """Check what a graph really answered: its file may declare other shapes.

    Raises:
        ModelError: If an output has not a row for each of `count` presses.
    """
    for name, rows in outputs.items():
        if rows.shape != (count, OUTPUTS[name]):
            raise ModelError(
                f"{where}: {name}: expected answers of shape {(count, OUTPUTS[name])}, got {rows.shape}; "
                "copy or export the model again"
            )


def check_interface(session: ort.InferenceSession, electrodes: int, where: str) -> None:
    """Check names, number type and shapes of a model's input and outputs; the batch must be free.

    Raises:
        ModelError: If they are not those of a model with this number of electrodes.
    """
    _check_tensors("input", session.get_inputs(), {INPUT: electrodes}, where)
    known = {name: width for name, width in OUTPUTS.items() if name != CORRELATION}
    _check_tensors("outputs", session.get_outputs(), known | outputs_of(session), where)


def _check_tensors(kind: str, tensors: list[ort.NodeArg], widths: dict[str, int], where: str) -> None:
    expected = {name: ("tensor(float)", width) for name, width in widths.items()}
    got = {tensor.name: (tensor.type, _row_width(tensor.shape)) for tensor in tensors}
    if got != expected:
        raise ModelError(
            f"{where}: expected the {kind} {_show(expected)}, got {_show(got)}; "
            "this is not a model of isocharge, or one of another version"
        )


def _row_width(shape: list[int | str | None]) -> object:
    """The width of a tensor of shape [any, width], or the shape itself if it is another one."""
    return shape[1] if len(shape) == 2 and not isinstance(shape[0], int) else shape


def _show(tensors: Mapping[str, tuple[str, object]]) -> str:
    return ", ".join(f"{name} {kind} [n, {width}]" for name, (kind, width) in tensors.items())


class BoundPress:
    """Input and output memory of one press, bound to a session.

    `write(q1, q2, ...)` puts the charges in, `run()` computes, `read()` gives the numbers of a Contact: ten, or
    seven from a model without correlations.

    Attributes:
        size: How many it gives.
        columns: Where each output lies in the row of these numbers.
    """

    def __init__(self, session: ort.InferenceSession, electrodes: int) -> None:
        charges = np.zeros((1, electrodes), dtype=np.float32)
        self.columns = _columns(outputs_of(session))
        self.size = max(part.stop for part in self.columns.values())
        answers = np.zeros(self.size, dtype=np.float32)
        # The session sees only addresses: the views in `write` and `read` keep the arrays alive.
        binding = _bind(session, charges, answers, self.columns)
        self.run: Callable[[], None] = partial(session.run_with_iobinding, binding)
        self.write = partial(struct.Struct(f"={electrodes}f").pack_into, charges.data.cast("B"), 0)
        self.read = partial(struct.Struct(f"={answers.size}f").unpack, answers.data.cast("B"))
        self._charges: Any = charges[0].data  # Any: typing knows a memoryview as bytes only
        self._answers: Any = answers.data
        self._first_seven: Any = answers[:SEVEN].data

    def run_into(self, charge_pC: Singles, out: Singles) -> None:
        """Compute from an array into an array; the copies through memoryviews check number type and shape at no cost.

        Raises:
            AttributeError, NotImplementedError, TypeError, ValueError: If an array has not the number type and shape of
                the bound memory; nothing is written into `out` then.
        """
        self._charges[:] = charge_pC
        self.run()
        target: Any = out.data
        target[:] = self._first_seven if len(target) == SEVEN else self._answers


SEVEN = 7
"""Numbers of a Contact without its correlations, which come after them."""


def _columns(outputs: Mapping[str, int]) -> dict[str, slice]:
    """Where outputs lie in the numbers of a Contact: the correlations, if there are any, last."""
    names, end = sorted(outputs, key=CORRELATION.__eq__), 0
    return {name: slice(end, end := end + outputs[name]) for name in names}


def _bind(
    session: ort.InferenceSession, charges: Singles, answers: Singles, columns: Mapping[str, slice]
) -> ort.IOBinding:
    """Bind the input (1, electrodes) and the outputs, in their columns of `answers`, by address."""
    binding = session.io_binding()
    binding.bind_input(INPUT, "cpu", 0, np.float32, charges.shape, charges.ctypes.data)
    for name, part in columns.items():
        width = part.stop - part.start
        binding.bind_output(name, "cpu", 0, np.float32, (1, width), answers[part].ctypes.data)
    return binding


LARGEST_SQUARE_SUM = 1e38
"""Sum of squared charges, pC^2, up to which each charge is certainly finite and fits into float32."""


def write_finite(write: Callable[..., object], values: Iterable[float]) -> bool:
    """Write numbers as float32 if they are finite and fit; the fast way for the few numbers of one press.

    Args:
        write: Takes the numbers one by one, as `struct.Struct("=3f").pack_into` does, and raises what that raises.
        values: The numbers, as many as `write` takes.

    Returns:
        Whether they were written and are finite; if not, what was written is not to be used.
    """
    try:
        numbers = tuple(values)
        write(*numbers)
        return math.isfinite(sum(numbers))  # float32 numbers cannot overflow a sum of float64
    except (struct.error, TypeError, ValueError, OverflowError):
        return False


def as_press(charge_pC: ArrayLike, electrodes: tuple[str, ...]) -> Singles:
    """The charges of one press as an array of shape (electrodes,), float32, pC.

    Raises:
        ChargeError: If the number of charges is another, or one is not finite; the electrode is named.
    """
    charges = _as_numbers(charge_pC, electrodes)
    if charges.shape != (len(electrodes),):
        raise ChargeError(f"expected {_charges(electrodes)}, got an array of shape {charges.shape}")
    return np.asarray(as_singles(charges[np.newaxis], electrodes, one_press=True)[0])


def as_batch(charge_pC: ArrayLike, electrodes: tuple[str, ...]) -> Singles:
    """The charges of n presses as a contiguous array of shape (n, electrodes), float32, pC.

    Raises:
        ChargeError: If the shape is another, or a charge is not finite; the electrode and the row are named.
    """
    charges = _as_numbers(charge_pC, electrodes)
    if charges.ndim != 2 or charges.shape[1] != len(electrodes):
        raise ChargeError(
            f"expected rows of {_charges(electrodes)}, shape (n, {len(electrodes)}), "
            f"got an array of shape {charges.shape}"
        )
    return as_singles(charges, electrodes)


def _charges(electrodes: tuple[str, ...]) -> str:
    return f"{len(electrodes)} charges {electrodes}"


def _as_numbers(charge_pC: ArrayLike, electrodes: tuple[str, ...]) -> NDArray[np.number]:
    try:
        charges = np.asarray(charge_pC)
    except ValueError as error:  # rows of different lengths
        raise ChargeError(f"expected {_charges(electrodes)} in each row, got {charge_pC!r:.200} ({error})") from error
    if charges.dtype.kind not in "fiu":
        raise ChargeError(f"expected {_charges(electrodes)} as numbers (pC), got {charge_pC!r:.200}")
    return charges


def as_singles(charges: NDArray[Any], electrodes: tuple[str, ...], *, one_press: bool = False) -> Singles:
    """Charges of shape (n, electrodes), pC, of any number type as a contiguous float32 array.

    Raises:
        ChargeError: If a charge is not finite; its electrode is named, and its row unless there is only `one_press`.
    """
    flat = charges.ravel()
    if (
        charges.dtype.kind == "f" and np.vdot(flat, flat) <= LARGEST_SQUARE_SUM
    ):  # one call instead of three and an errstate
        return np.ascontiguousarray(charges, dtype=np.float32)
    return _examined(charges, electrodes, one_press)


def _examined(charges: NDArray[np.number], electrodes: tuple[str, ...], one_press: bool) -> Singles:
    """Charges one by one; the first row with a bad one is named."""
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite and is refused below
        singles = np.ascontiguousarray(charges, dtype=np.float32)
    rows, columns = np.nonzero(~np.isfinite(singles))
    if rows.size:
        row = rows[0]
        bad = [f"{electrodes[column]!r} ({charges[row, column]})" for column in columns[rows == row]]
        where = "" if one_press else f" in row {row} (rows count from 0)"
        raise ChargeError(f"expected finite charges (pC), got{where} for electrode {', '.join(bad)}")
    return singles
