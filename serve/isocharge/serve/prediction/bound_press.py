"""Input and output memory of one press, bound to an ONNX session once."""

import struct
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import onnxruntime as ort

from isocharge.common.arrays import Singles
from isocharge.serve.model.session import INPUT, OUTPUTS


class BoundPress:
    """Input and output memory of one press, bound to a session.

    `write(q1, q2, ...)` puts the charges in, `run()` computes, `read()` gives the seven numbers of a Contact.
    """

    def __init__(self, session: ort.InferenceSession, electrodes: int) -> None:
        charges = np.zeros((1, electrodes), dtype=np.float32)
        answers = np.zeros(sum(OUTPUTS.values()), dtype=np.float32)
        # The session sees only addresses: the views in `write` and `read` keep the arrays alive.
        self.run: Callable[[], None] = partial(session.run_with_iobinding, _bind(session, charges, answers))
        self.write = partial(struct.Struct(f"={electrodes}f").pack_into, charges.data.cast("B"), 0)
        self.read = partial(struct.Struct(f"={answers.size}f").unpack, answers.data.cast("B"))
        self._charges: Any = charges[0].data  # Any: typing knows a memoryview as bytes only
        self._answers: Any = answers.data

    def run_into(self, charge_pC: Singles, out: Singles) -> None:
        """Compute from an array into an array; the copies through memoryviews check number type and shape at no cost.

        Raises:
            AttributeError, NotImplementedError, TypeError, ValueError: If an array has not the number type and shape of
                the bound memory; nothing is written into `out` then.
        """
        self._charges[:] = charge_pC
        self.run()
        target: Any = out.data
        target[:] = self._answers


def _bind(session: ort.InferenceSession, charges: Singles, answers: Singles) -> ort.IOBinding:
    """Bind the input (1, electrodes) and the outputs, one after the other in `answers`, by address."""
    binding = session.io_binding()
    binding.bind_input(INPUT, "cpu", 0, np.float32, charges.shape, charges.ctypes.data)
    start = 0
    for name, width in OUTPUTS.items():
        binding.bind_output(name, "cpu", 0, np.float32, (1, width), answers[start:].ctypes.data)
        start += width
    return binding
