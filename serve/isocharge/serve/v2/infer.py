"""One inference: charges in, the chosen outputs out, whoever carries them."""

import time
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from isocharge.serve.arrays import Singles
from isocharge.serve.session import INPUT
from isocharge.serve.shelf import Served

Written = TypeVar("Written")


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


def infer(served: Served, request: InferRequest) -> InferAnswer:
    """Run the model; may be called from any thread."""
    values = served.model.session.run(request.outputs, {INPUT: request.charge_pC})
    outputs = dict(zip(request.outputs, values, strict=True))
    metadata = served.metadata
    return InferAnswer(metadata.name, str(metadata.version), request.id, outputs, request.binary)


def answer_inference(
    served: Served, read: Callable[[], InferRequest], write: Callable[[InferAnswer], Written]
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
