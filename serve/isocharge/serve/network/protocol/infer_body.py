"""The JSON body of a request for an inference, from which the schema in the OpenAPI document is derived, too."""

from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

Unsupported = Annotated[None, Meta(description="nothing, as this server does not support it")]


class Parameters(Struct, frozen=True):
    """Parameters of a request, an input or an output. Unknown parameters are ignored, as Triton does."""

    binary_data: bool | None = None
    binary_data_output: bool = False
    binary_data_size: int | None = None
    shared_memory_region: Unsupported = None
    classification: Unsupported = None


class InputTensor(Struct, frozen=True):
    """Input tensor with the charges, pC. The numbers are checked later, when the shape is known to be valid."""

    name: Literal["charge_pC"]
    datatype: Literal["FP32", "FP64"]
    shape: list[int]
    data: Annotated[Any, Meta(extra_json_schema={"type": "array", "description": "numbers, flat or in rows"})] = None
    parameters: Parameters = Parameters()


class OutputTensor(Struct, frozen=True):
    """Requested output."""

    name: Literal["contact", "contact_std", "contact_correlation", "misfit", "flags"]
    parameters: Parameters = Parameters()


class InferBody(Struct, frozen=True):
    """Body of a request for an inference."""

    inputs: Annotated[list[InputTensor], Meta(min_length=1, max_length=1, description="a list with one tensor")]
    id: str = ""
    outputs: list[OutputTensor] = []
    parameters: Parameters = Parameters()
