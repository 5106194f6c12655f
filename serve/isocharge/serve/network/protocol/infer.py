"""One inference: charges in, the chosen outputs out, whoever carries them."""

import time
from collections.abc import Callable
from itertools import accumulate
from typing import NamedTuple, TypeVar

import numpy as np

from isocharge.arrays import Singles
from isocharge.serve.model.session import INPUT, OUTPUTS
from isocharge.serve.network.model_store import LoadedVersion
from isocharge.serve.prediction.bound_press import BoundPress

Written = TypeVar("Written")

ENDS = tuple(accumulate(OUTPUTS.values()))

WIDTH = ENDS[-1]

COLUMNS = {name: slice(end - OUTPUTS[name], end) for name, end in zip(OUTPUTS, ENDS, strict=True)}
"""Where each output lies in the row of numbers that is bound for one press."""


class InferRequest(NamedTuple):
    """What is asked of a model.

    Attributes:
        id: Echoed in the answer; empty if the request has none.
        charge_pC: Shape (n, electrodes), pC.
        outputs: Names, in the order of the answer.
        binary: Those of them that are to be sent in binary.
    """

    id: str
    charge_pC: Singles
    outputs: tuple[str, ...]
    binary: frozenset[str]


class InferAnswer(NamedTuple):
    """What a model answers.

    Attributes:
        name, version: Which model it was.
        id, binary: As in the request.
        outputs: By name, shape (n, width).
    """

    name: str
    version: str
    id: str
    outputs: dict[str, Singles]
    binary: frozenset[str]


def infer(served: LoadedVersion, request: InferRequest) -> InferAnswer:
    """Run the model; may be called from any thread."""
    charges, names = request.charge_pC, request.outputs
    if len(charges) == 1:
        outputs = _one_press(served.press(), charges[0], names)
    else:
        outputs = dict(zip(names, served.model.session.run(names, {INPUT: charges}), strict=True))
    return InferAnswer(served.metadata.name, served.version, request.id, outputs, request.binary)


def _one_press(press: BoundPress, charge_pC: Singles, names: tuple[str, ...]) -> dict[str, Singles]:
    """Outputs of shape (1, width) from bound memory, which is faster than a plain run."""
    row = np.empty((1, WIDTH), np.float32)
    press.run_into(charge_pC, row[0])
    return {name: row[:, COLUMNS[name]] for name in names}


def answer_inference(
    served: LoadedVersion, read: Callable[[], InferRequest], write: Callable[[InferAnswer], Written]
) -> Written:
    """Read a request, run the model, write the answer, and count it.

    Args:
        served: The model.
        read: Gives the request, or raises why it is none.
        write: Puts the answer into what the transport sends.

    Raises:
        Whatever `read` raises.
    """
    clock = time.perf_counter_ns
    began = clock()
    try:
        request = read()
        was_read = clock()
        answer = infer(served, request)
        ran = clock()
        written = write(answer)
    except Exception:
        served.statistics.failed(clock() - began)
        raise
    served.statistics.succeeded(len(request.charge_pC), (was_read - began, ran - was_read, clock() - ran))
    return written
