"""One inference: charges in, the chosen outputs out, for every transport."""

import time
from collections.abc import Callable
from itertools import accumulate
from typing import TypeVar

import numpy as np

from isocharge.common.arrays import Singles
from isocharge.serve.model.session import OUTPUTS, check_rows, run, run_error
from isocharge.serve.network.model_store import LoadedVersion
from isocharge.serve.network.protocol.request import InferAnswer, InferRequest

Written = TypeVar("Written")

_ENDS = tuple(accumulate(OUTPUTS.values()))

COLUMNS = {name: slice(end - OUTPUTS[name], end) for name, end in zip(OUTPUTS, _ENDS, strict=True)}
"""Where each output lies in the row of numbers that is bound for one press."""


def infer(loaded: LoadedVersion, charge_pC: Singles, names: tuple[str, ...]) -> tuple[dict[str, Singles], int, int]:
    """Run the model; may be called from any thread.

    Returns:
        Outputs by name, shape (n, width); how many presses were not checked for their misfit, as nobody asked for it;
        and how many have one above the limit of the model, or none that is a number.

    Raises:
        ModelError: If its graph fails.
    """
    if len(charge_pC) == 1:
        row = _one_press(loaded, charge_pC[0])
        misfit = row[:, COLUMNS["misfit"]]
        return {name: row[:, COLUMNS[name]] for name in names}, 0, int(not misfit.item() <= loaded.misfit_limit)
    outputs = run(loaded.model.session, charge_pC, names)
    check_rows(outputs, len(charge_pC), loaded.metadata.label)
    if "misfit" not in outputs:
        return outputs, len(charge_pC), 0
    return outputs, 0, len(charge_pC) - int(np.count_nonzero(outputs["misfit"] <= loaded.misfit_limit))


def _one_press(loaded: LoadedVersion, charge_pC: Singles) -> Singles:
    """All outputs in a row, shape (1, 7), from bound memory, which is faster than a plain run."""
    row = np.empty((1, _ENDS[-1]), np.float32)
    try:
        loaded.press().run_into(charge_pC, row[0])
    except Exception as error:  # onnxruntime's exceptions have no common base of their own
        raise run_error(error) from error
    return row


def answer_inference(
    loaded: LoadedVersion, read: Callable[[], InferRequest], write: Callable[[InferAnswer], Written]
) -> Written:
    """Read a request, run the model, write the answer, and count it.

    Args:
        loaded: The model.
        read: Returns the request, or raises what is wrong with it.
        write: Turns the answer into what the transport sends.

    Raises:
        Whatever `read` raises.
    """
    clock = time.perf_counter_ns
    began = clock()
    try:
        request = read()
        was_read = clock()
        outputs, unchecked, alarms = infer(loaded, request.charge_pC, request.outputs)
        ran = clock()
        written = write(InferAnswer(loaded.metadata.name, loaded.version, request.id, outputs, request.binary))
    except Exception:
        loaded.statistics.failed(clock() - began)
        raise
    stages_ns = was_read - began, ran - was_read, clock() - ran
    loaded.statistics.succeeded(len(request.charge_pC), stages_ns, unchecked, alarms)
    return written
