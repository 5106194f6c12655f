"""Functions that open, check and run the ONNX session of a model, and convert charges to the inputs of the session.

The network of a model takes microseconds to run. A session therefore uses one thread, because a second thread would
cost more time than it saves. Between two runs, the session sleeps. By default, onnxruntime would wait actively, and a
stream of 100 frames per second would keep most of a processor core busy. `BoundPress` is the fastest way to compute one
press, because its memory for input and output is bound to the session only once.

Charges must be finite numbers in the order of the electrodes. `write_finite` is a fast check for plain numbers.
"""

import struct
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import onnxruntime as ort

from isocharge.common.arrays import Singles
from isocharge.common.errors import ModelError, cut

INPUT = "charge_pC"
"""Name of the input."""

CORRELATION = "contact_correlation"
"""Name of the output with the correlations, which come last in a `Contact`."""

OUTPUTS = {"contact": 3, "contact_std": 3, CORRELATION: 3, "misfit": 1}
"""Names of the outputs and their numbers of columns. `isocharge.serve.model.contact.Contact` describes the columns."""

COLUMNS = {"contact": slice(0, 3), "contact_std": slice(3, 6), "misfit": slice(6, 7), CORRELATION: slice(7, 10)}
"""Columns of each output among the ten values of a `Contact`."""

N_WITHOUT_CORRELATION = COLUMNS[CORRELATION].start
"""Number of values of a `Contact` before its correlations."""

EXTERNAL_DATA = b"\x0a\x08location"
"""Encoded key of the entry of an ONNX tensor that names the file with the numbers of the tensor."""


def open_session(onnx_model: bytes, where: str) -> ort.InferenceSession:
    """Open a session of a model that uses one thread.

    This function does not check the inputs and outputs of the model. Use `check_interface` for this check.

    Args:
        onnx_model: Content of `model.onnx`.
        where: Name or file of the model, for error messages.

    Raises:
        ModelError: If the bytes are not an ONNX graph that onnxruntime can run, or if the graph loads external data.
    """
    if EXTERNAL_DATA in onnx_model:
        raise ModelError(
            f"{where}: expected a model with all of its numbers inside, got one that loads external data from another "
            "file, which no checksum covers; save the model again with onnx.save(model, path, "
            "save_as_external_data=False)"
        )
    try:
        session = ort.InferenceSession(onnx_model, _single_thread_options(), providers=["CPUExecutionProvider"])
        # onnxruntime raises an exception when a text that is not valid UTF-8 is read.
        _ = session.get_modelmeta().custom_metadata_map
        _ = [tensor.name for tensor in (*session.get_inputs(), *session.get_outputs())]
        return session
    except Exception as error:  # onnxruntime's exceptions have no common base class of their own
        raise ModelError(
            f"{where}: onnxruntime {ort.__version__} cannot read these {len(onnx_model)} bytes as a model "
            f"({cut(str(error))}); copy or export it again"
        ) from error


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


def run(session: ort.InferenceSession, charge_pC: Singles) -> dict[str, Singles]:
    """Compute the outputs of a model for a batch of presses.

    Args:
        session: Session of the model.
        charge_pC: Charges, shape (n, electrodes), pC.

    Returns:
        Outputs by name in the order of `OUTPUTS`, each of shape (n, width).

    Raises:
        ModelError: If onnxruntime cannot run the graph on these charges, or an output has another shape than the graph
            declares.
    """
    try:
        outputs = dict(zip(OUTPUTS, session.run(tuple(OUTPUTS), {INPUT: charge_pC}), strict=True))
    except Exception as error:  # onnxruntime's exceptions have no common base class of their own
        raise run_error(error) from error
    for name, width in OUTPUTS.items():
        if outputs[name].shape != (len(charge_pC), width):
            raise run_error(ValueError(f"{name} has the shape {outputs[name].shape}"))
    return outputs


def run_error(error: Exception) -> ModelError:
    """Return the error for a graph that onnxruntime can read but cannot run."""
    return ModelError(f"the model's graph fails when it is run ({cut(str(error))}); copy or export it again")


def check_interface(session: ort.InferenceSession, n_electrode: int, where: str) -> None:
    """Check that the input and the outputs of a model have the required names, number types and shapes.

    The number of presses in a batch must be variable.

    Args:
        session: Session of the model.
        n_electrode: Number of electrodes of the model.
        where: Name or file of the model, for error messages.

    Raises:
        ModelError: If the input or an output is missing, is not as required, or is not expected.
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
        values = np.zeros(sum(OUTPUTS.values()), dtype=np.float32)
        # The session stores only the addresses of the arrays. The views in `write` and `read` keep the arrays alive.
        binding = session.io_binding()
        binding.bind_input(INPUT, "cpu", 0, np.float32, charges.shape, charges.ctypes.data)
        for name, columns in COLUMNS.items():
            output = values[np.newaxis, columns]
            binding.bind_output(name, "cpu", 0, np.float32, output.shape, output.ctypes.data)
        self.run: Callable[[], None] = partial(session.run_with_iobinding, binding)

        # Functions that write float32 numbers into the memory of the charges, and read the numbers of the outputs
        self.write = partial(struct.Struct(f"={n_electrode}f").pack_into, charges.data.cast("B"), 0)  # from byte 0 on
        self.read = partial(struct.Struct(f"={values.size}f").unpack, values.data.cast("B"))
        # The type is Any because the type hints of memoryview cover only bytes.
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
