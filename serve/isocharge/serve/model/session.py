"""ONNX sessions as this package runs them: one thread, in order, no spinning, with a checked interface.

A network of this size takes microseconds. A second thread costs more than it saves, and onnxruntime's default, to spin
between runs, burns most of a core at 100 Hz.
"""

from collections.abc import Mapping, Sequence

import onnxruntime as ort

from isocharge.common.arrays import Singles
from isocharge.common.errors import ModelError, cut

INPUT = "charge_pC"
"""Name of the input."""

OUTPUTS = {"contact": 3, "contact_std": 3, "misfit": 1}
"""Names and widths of the outputs: x_mm, y_mm, force_N; their standard deviations; the misfit."""


def open_session(onnx_model: bytes, where: str) -> ort.InferenceSession:
    """A session for one thread, whose interface is not checked yet.

    Raises:
        ModelError: If the bytes are not an ONNX graph that onnxruntime can run.
    """
    try:
        return ort.InferenceSession(onnx_model, _options(), providers=["CPUExecutionProvider"])
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


def run(session: ort.InferenceSession, charge_pC: Singles, names: Sequence[str] = tuple(OUTPUTS)) -> dict[str, Singles]:
    """Outputs by name, shape (n, width), from charges of shape (n, electrodes), pC.

    Raises:
        ModelError: If the graph cannot be run on them: it is not the model of these charges.
    """
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
    _check_tensors("outputs", session.get_outputs(), OUTPUTS, where)


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
