"""One inference: charges in, the chosen outputs out, for every transport."""

import time
from collections.abc import Callable
from itertools import accumulate
from typing import NamedTuple, TypeVar

import numpy as np

from isocharge.common.arrays import Singles
from isocharge.serve.model.session import OUTPUTS, check_rows, run, run_error
from isocharge.serve.network.model_store import LoadedVersion
from isocharge.serve.prediction.bound_press import BoundPress

Written = TypeVar("Written")

_ENDS = tuple(accumulate(OUTPUTS.values()))

WIDTH = _ENDS[-1]
"""Numbers that the model answers for one press."""

COLUMNS = {name: slice(end - OUTPUTS[name], end) for name, end in zip(OUTPUTS, _ENDS, strict=True)}
"""Where each output lies in the row of numbers that is bound for one press."""

MISFIT = COLUMNS["misfit"].start
"""Where the misfit lies in it."""


class InferRequest(NamedTuple):
    """Charges for a model, and which of its outputs to answer with.

    Attributes:
        id: Echoed in the answer; empty if the request has none.
        charge_pC: Shape (n, electrodes), pC.
        outputs: Names, in the order of the answer.
        binary: Names of the outputs that are sent in binary.
    """

    id: str
    charge_pC: Singles
    outputs: tuple[str, ...]
    binary: frozenset[str]


class InferAnswer(NamedTuple):
    """Outputs of a model for one request.

    Attributes:
        name, version: The model that answered.
        id, binary: As in the request.
        outputs: By name, shape (n, width).
        unchecked: Presses whose misfit was not computed, as nobody asked for it.
        alarms: Presses whose misfit is above the limit of the model.
    """

    name: str
    version: str
    id: str
    outputs: dict[str, Singles]
    binary: frozenset[str]
    unchecked: int
    alarms: int


def infer(loaded: LoadedVersion, request: InferRequest) -> InferAnswer:
    """Run the model; may be called from any thread.

    Raises:
        ModelError: If its graph fails.
    """
    charges, names, metadata = request.charge_pC, request.outputs, loaded.metadata
    if len(charges) == 1:
        row = _one_press(loaded.press(), charges[0])
        outputs, unchecked = {name: row[:, COLUMNS[name]] for name in names}, 0
        alarms = 0 if row.item(MISFIT) <= loaded.misfit_limit else 1  # one for NaN, too
    else:
        outputs = run(loaded.model.session, charges, names)
        check_rows(outputs, len(charges), metadata.label)
        unchecked, alarms = _misfit_alarms(outputs.get("misfit"), len(charges), loaded.misfit_limit)
    return InferAnswer(metadata.name, loaded.version, request.id, outputs, request.binary, unchecked, alarms)


def _one_press(press: BoundPress, charge_pC: Singles) -> Singles:
    """All outputs, shape (1, WIDTH), from bound memory, which is faster than a plain run."""
    row = np.empty((1, WIDTH), np.float32)
    try:
        press.run_into(charge_pC, row[0])
    except Exception as error:  # onnxruntime's exceptions have no common base of their own
        raise run_error(error) from error
    return row


def _misfit_alarms(misfit: Singles | None, presses: int, limit: float) -> tuple[int, int]:
    """How many presses were not checked, and how many are above the limit; NaN counts as above."""
    return (presses, 0) if misfit is None else (0, presses - int(np.count_nonzero(misfit <= limit)))


def answer_inference(
    loaded: LoadedVersion,
    read: Callable[[], InferRequest],
    write: Callable[[InferAnswer], Written],
    *,
    over_grpc: bool = False,
) -> Written:
    """Read a request, run the model, write the answer, and count it.

    Args:
        loaded: The model.
        read: Returns the request, or raises what is wrong with it.
        write: Turns the answer into what the transport sends.
        over_grpc: Whether that is gRPC.

    Raises:
        Whatever `read` raises.
    """
    clock = time.perf_counter_ns
    began = clock()
    try:
        request = read()
        was_read = clock()
        answer = infer(loaded, request)
        ran = clock()
        written = write(answer)
    except Exception:
        loaded.statistics.failed(clock() - began)
        raise
    stages_ns = was_read - began, ran - was_read, clock() - ran
    loaded.statistics.succeeded(len(request.charge_pC), stages_ns, answer.unchecked, answer.alarms, over_grpc=over_grpc)
    return written
