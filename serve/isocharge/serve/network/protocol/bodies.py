"""JSON bodies of requests.

Some clients send `null` for every field that is not given. All optional fields therefore accept `null`.
"""

from typing import Annotated, Literal

from msgspec import Meta, Struct

Unsupported = Annotated[None, Meta(description="nothing, as this server does not support it")]


class Parameters(Struct, frozen=True):
    """Parameters of a request, of an input or of an output. Unknown parameters are ignored, as in Triton."""

    binary_data: bool | None = None
    binary_data_output: bool | None = None
    binary_data_size: int | None = None
    shared_memory_region: Unsupported = None
    classification: Unsupported = None


class InputTensor(Struct, frozen=True):
    """Input tensor with the charges, pC."""

    name: Literal["charge_pC"]
    datatype: Literal["FP32", "FP64"]
    shape: list[int]
    data: Annotated[list[float | list[float]], Meta(description="numbers, flat or in rows")] | None = None
    parameters: Parameters | None = None


class OutputTensor(Struct, frozen=True):
    """Output that the client requests."""

    name: Literal["contact", "contact_std", "contact_correlation", "misfit", "flags"]
    parameters: Parameters | None = None


class InferBody(Struct, frozen=True):
    """Body of a request for an inference."""

    inputs: Annotated[list[InputTensor], Meta(min_length=1, max_length=1, description="a list with one tensor")]
    id: str | None = None
    outputs: list[OutputTensor] | None = None
    parameters: Parameters | None = None


class IndexBody(Struct, frozen=True):
    """Body of a request for the index of the repository."""

    ready: bool | None = None
