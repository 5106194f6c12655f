"""Parameters of a request, an input or an output: `"parameters": {name: value}` in JSON."""

from typing import Any

from isocharge.common.errors import RequestError

UNSUPPORTED = ("shared_memory_region", "classification")
"""Parameters of Triton that change what a request means and that this server does not know."""


def parameters_of(holder: dict[str, Any]) -> dict[str, Any]:
    """The parameters of a request, input or output; unknown ones are ignored, as Triton does.

    Raises:
        RequestError: If they are no object, or one of them is not supported.
    """
    parameters = holder.get("parameters")
    if parameters is None:
        return {}
    if not isinstance(parameters, dict):
        raise RequestError(f"parameters: expected an object, got {parameters!r:.100}")
    for name in UNSUPPORTED:
        if parameters.get(name):
            raise RequestError(f"parameters: {name!r} is not supported by this server")
    return parameters


def flag(holder: dict[str, Any], name: str, *, default: bool) -> bool:
    """A yes or no among the parameters.

    Raises:
        RequestError: If it is neither true nor false.
    """
    value = parameters_of(holder).get(name, default)
    if not isinstance(value, bool):
        raise RequestError(f"the parameter {name!r}: expected true or false, got {value!r:.100}")
    return value
