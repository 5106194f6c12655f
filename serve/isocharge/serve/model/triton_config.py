"""`config.pbtxt`: with it Triton serves a model folder without changes."""

from isocharge.common.defaults import MAX_BATCH
from isocharge.serve.model.session import INPUT, OUTPUTS


def triton_config(name: str, electrodes: int) -> str:
    """The text of `config.pbtxt` for a model with this number of electrodes; Triton adds the batch dimension."""
    head = f'name: "{name}"\nplatform: "onnxruntime_onnx"\nmax_batch_size: {MAX_BATCH}\n'
    return head + _tensors("input", {INPUT: electrodes}) + _tensors("output", OUTPUTS)


def _tensors(kind: str, widths: dict[str, int]) -> str:
    lines = [f'  {{ name: "{name}" data_type: TYPE_FP32 dims: [ {width} ] }}' for name, width in widths.items()]
    return f"{kind} [\n" + ",\n".join(lines) + "\n]\n"
