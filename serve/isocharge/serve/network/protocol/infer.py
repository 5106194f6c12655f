"""One inference: charges in, the chosen outputs out, for every transport."""

import time
from collections.abc import Callable
from itertools import accumulate
from typing import NamedTuple, TypeVar

import numpy as np

from isocharge.arrays import Singles
from isocharge.serve.model.session import OUTPUTS, check_rows, run, run_error
from isocharge.serve.network.model_store import LoadedVersion
from isocharge.serve.prediction.bound_press import BoundPress

Written = TypeVar("Written")

_ENDS = tuple(accumulate(OUTPUTS.values()))

WIDTH = _ENDS[-1]
"""Numbers that the model answers for one press."""

COLUMNS = {name: slice(end - OUTPUTS[name], end) for name, end in zip(OUTPUTS, _ENDS, strict=True)}
"""Where each output lies in the row of numbers that is bound for one press."""


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
        misfit: Misfit of each press, shape (n, 1); None if it was not computed, as nobody asked for it.
    """

    name: str
    version: str
    id: str
    outputs: dict[str, Singles]
    binary: frozenset[str]
    misfit: Singles | None = None


def infer(loaded: LoadedVersion, request: InferRequest) -> InferAnswer:
    """Run the model; may be called from any thread.

    Raises:
        ModelError: If its graph fails.
    """
    charges, names = request.charge_pC, request.outputs
    if len(charges) == 1:
        row = _one_press(loaded.press(), charges[0])
        outputs, misfit = {name: row[:, COLUMNS[name]] for name in names}, row[:, COLUMNS["misfit"]]
    else:
        outputs = run(loaded.model.session, charges, names)
        check_rows(outputs, len(charges), loaded.metadata.label)
        misfit = outputs.get("misfit")
    return InferAnswer(loaded.metadata.name, loaded.version, request.id, outputs, request.binary, misfit)


def _one_press(press: BoundPress, charge_pC: Singles) -> Singles:
    """All outputs, shape (1, WIDTH), from bound memory, which is faster than a plain run."""
    row = np.empty((1, WIDTH), np.float32)
    try:
        press.run_into(charge_pC, row[0])
    except Exception as error:  # onnxruntime's exceptions have no common base of their own
        raise run_error(error) from error
    return row


def misfit_alarms(misfit: Singles | None, limit: float) -> tuple[int, int]:
    """Presses whose misfit was computed, and how many of them are above the limit; NaN counts as above."""
    if misfit is None:
        return 0, 0
    if len(misfit) == 1:
        return 1, int(not misfit.item() <= limit)
    return len(misfit), len(misfit) - int(np.count_nonzero(misfit <= limit))


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
        answer = infer(loaded, request)
        ran = clock()
        written = write(answer)
    except Exception:
        loaded.statistics.failed(clock() - began)
        raise
    stages_ns = was_read - began, ran - was_read, clock() - ran
    loaded.statistics.succeeded(len(request.charge_pC), stages_ns, *misfit_alarms(answer.misfit, loaded.misfit_limit))
    return written
