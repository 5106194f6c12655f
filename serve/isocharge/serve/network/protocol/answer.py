"""The body of an inference answer: JSON, followed by the tensors that the request asked for in binary."""

from typing import Any

import orjson

from isocharge.common.arrays import Singles
from isocharge.serve.network.protocol.infer import InferAnswer


def write_answer(answer: InferAnswer) -> tuple[bytes, int | None]:
    """Put an answer into bytes.

    Args:
        answer: Outputs of the model, and which of them to send in binary.

    Returns:
        The body, and where its JSON ends if binary tensors follow.
    """
    content: dict[str, Any] = {"model_name": answer.name, "model_version": answer.version}
    if answer.id:
        content["id"] = answer.id
    content["outputs"] = [_tensor(name, rows, name in answer.binary) for name, rows in answer.outputs.items()]
    text = orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)
    if not answer.binary:
        return text, None
    parts = [rows.astype("<f4", copy=False).tobytes() for name, rows in answer.outputs.items() if name in answer.binary]
    return b"".join([text, *parts]), len(text)


def _tensor(name: str, rows: Singles, in_binary: bool) -> dict[str, Any]:
    """One tensor, its numbers flat and row by row, or only their number of bytes."""
    if in_binary:
        size = {"binary_data_size": rows.nbytes}
        return {"name": name, "datatype": "FP32", "shape": rows.shape, "parameters": size}
    return {"name": name, "datatype": "FP32", "shape": rows.shape, "data": rows.ravel()}
