"""Service that answers the calls of `inference.GRPCInferenceService`.

The service uses the same models, limits and token as the HTTP server.

Every method of the service is declared as a method that receives a stream of messages. The token and the limits can
therefore be checked before the first message of a call arrives. If a new call exceeds the limit on open calls, the
service ends the call that has waited longest for a message from its client.

The message classes are created from the compiled file `inference.proto` in a separate descriptor pool. A program can
therefore also import another implementation of the protocol, although the messages of both implementations have the
same names. The function `read_request` reads a request for an inference, and `write_response` writes its response.
All other messages are converted from and to the JSON objects of the HTTP routes.
"""

import asyncio
import time
from importlib.resources import files
from typing import Any

import grpc
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.json_format import MessageToJson, ParseDict
from google.protobuf.message import DecodeError
from google.protobuf.message_factory import GetMessageClass
from grpc.aio import EOF, InternalError, ServicerContext

from isocharge.common.errors import ModelError, RequestError
from isocharge.common.structs import convert
from isocharge.serve.network.protocol.handler import Handler
from isocharge.serve.network.protocol.inference import InferBody, Json, infer
from isocharge.serve.network.protocol.response import refusal
from isocharge.serve.network.protocol.routes import ROUTES, Request

SERVICE = "inference.GRPCInferenceService"
"""Full name of the gRPC service."""

_COMPILED_PROTOCOL = files(__package__).joinpath("inference.binpb").read_bytes()
(_PROTOCOL,) = FileDescriptorSet.FromString(_COMPILED_PROTOCOL).file
_POOL = DescriptorPool()
_POOL.Add(_PROTOCOL)

METHODS = {
    method.name: (GetMessageClass(method.input_type), GetMessageClass(method.output_type))
    for method in _POOL.FindServiceByName(SERVICE).methods
}
"""Class of the request and class of the response, by the name of the method."""


def read_request(message: Any) -> tuple[InferBody, bytes]:
    """Read a ModelInferRequest, and return its content and the charges that are sent as raw contents.

    Args:
        message: The ModelInferRequest.

    Raises:
        RequestError: If the message is not a request for an inference.
    """
    raw_contents = message.raw_input_contents
    if len(raw_contents) > 1:
        raise RequestError(f"raw_input_contents: expected the bytes of one input tensor, got {len(raw_contents)}")
    content = {
        "id": message.id,
        "inputs": [
            {
                "name": tensor.name,
                "datatype": tensor.datatype,
                "shape": [*tensor.shape],
                # Numbers of the type FP32 are in the list `fp32_contents`, for example. There is no such list if the
                # type is unknown. The list is empty if the client has sent raw contents instead, and `InferBody` states
                # this by None.
                "data": [*getattr(tensor.contents, f"{tensor.datatype.lower()}_contents", ())] or None,
            }
            for tensor in message.inputs
        ],
        "outputs": [{"name": output.name} for output in message.outputs],
        "parameters": {"binary_data_output": bool(raw_contents)},  # raw contents are answered by raw contents
    }
    return convert(content, InferBody, "", RequestError), b"".join(raw_contents)


def write_response(content: Json, raw_contents: list[bytes]) -> Any:
    """Convert the content of an HTTP response to a ModelInferResponse, and return this message.

    The message is not sent here.

    Args:
        content: Content of the HTTP response. The function changes its outputs.
        raw_contents: Binary tensors of all outputs. The list is empty if the content itself contains the values of the
            outputs.
    """
    for tensor in content["outputs"]:
        if raw_contents:
            # The only parameter is the size of the binary tensor. In the message, each raw content has a length itself.
            del tensor["parameters"]
        elif tensor["datatype"] == "BYTES":
            tensor["contents"] = {"bytes_contents": [text.encode() for text in tensor.pop("data")]}
        else:
            tensor["contents"] = {"fp32_contents": tensor.pop("data").tolist()}
    _, response_type = METHODS["ModelInfer"]
    return response_type(**content, raw_output_contents=raw_contents)


ROUTE_OF_METHOD = {name: route for route in ROUTES for name in route.rpcs}
"""Route of the HTTP server that gives the same answer, by the name of the gRPC method."""

ANSWER_FIELDS = {"ModelConfig": "config", "RepositoryIndex": "models"}
"""Field of the response that contains the answer, by the name of the method. Any other response is the answer."""

GRPC_STATUSES = {
    400: "INVALID_ARGUMENT",
    401: "UNAUTHENTICATED",
    404: "NOT_FOUND",
    408: "DEADLINE_EXCEEDED",
    413: "RESOURCE_EXHAUSTED",
    429: "RESOURCE_EXHAUSTED",
    500: "INTERNAL",
}
"""Name of the gRPC status for each HTTP status with the same meaning."""

TIMEOUT_MESSAGE = "the client sent or read nothing for too long, another call needed the place, or the server stopped"
"""Message to a client whose call has taken too long."""

STREAM_METHOD = "ModelStreamInfer"
"""Name of the method that receives and sends several messages in one call."""


class Service:
    """gRPC service that answers calls with the models, the token and the limits of a `Handler`."""

    def __init__(self, handler: Handler) -> None:
        """Share the models, limits, counters and access check of the HTTP server, and count the open calls.

        Args:
            handler: Handler of the requests of the HTTP server.
        """
        self._handler = handler
        self._open_count = 0
        self._is_stopping = False
        # One timeout for each call that waits for a message of its client, in the order in which the waits began. The
        # dictionary serves as an ordered set: all its values are None.
        self._waiting_timeouts: dict[asyncio.Timeout, None] = {}
        handler.traffic.open.labels("grpc").set_function(lambda: self._open_count)

    async def handle(self, name: str, _messages: object, context: ServicerContext) -> None:
        """Answer a call of a client, count the call by its status, and log the call if there is a log.

        If an error occurs, the client receives the status and the message of the error.

        Args:
            name: Name of the method.
            _messages: Iterator over the messages. It is not used, because the messages are read from the context.
            context: Context of the call, from which messages are read and to which responses are written.

        Raises:
            CancelledError: If the client has ended the call.
        """
        start_ns = time.perf_counter_ns()
        client = context.peer()  # would be empty at the end, if the client has disconnected meanwhile
        status = "CANCELLED"  # until the call is answered or refused
        error_message = ""
        self._open_count += 1
        try:
            self._limit_open_calls()
            await self._answer(name, context)
            status = "OK"
        except InternalError as error:  # the client has ended the call during a read or a write
            raise asyncio.CancelledError from error
        except Exception as error:  # every error is sent to the client
            reported_error = RequestError(TIMEOUT_MESSAGE, 408) if isinstance(error, TimeoutError) else error
            http_status, error_message = refusal(reported_error)
            status = GRPC_STATUSES[http_status]
        finally:
            self._open_count -= 1
            self._handler.traffic.count("grpc", name, status, client, start_ns)
        if error_message:  # the call was refused; send the status and the message to the client
            await context.abort(grpc.StatusCode[status], error_message)

    async def _answer(self, name: str, context: ServicerContext) -> None:
        """Check the token, and answer the messages of a call.

        A call of the method `STREAM_METHOD` may contain any number of messages, and every other call contains one
        message. The first message must arrive within `header_seconds`, and each later message within `idle_seconds`
        after the previous response. The client must read each response within `body_seconds`. If the server has been
        told to stop, no message is read after the present message.

        Args:
            name: Name of the method.
            context: Context of the call, from which messages are read and to which responses are written.

        Raises:
            TimeoutError: If the client does not send a message or does not read a response in time.
            IsochargeError: If the call is refused, or if it contains no message.
        """
        if ROUTE_OF_METHOD[name].needs_token:
            metadata = dict(context.invocation_metadata())
            authorization = metadata.get("authorization", "")
            self._handler.access.check_token(authorization.encode())
        timeout_s = self._handler.limits.header_seconds  # for the first message; later messages have another timeout
        while (data := await self._next_message(context, timeout_s)) is not EOF:
            if name.startswith("RepositoryModel"):  # these methods load or unload a model, which may take a long time
                response = await asyncio.to_thread(self._response_to, name, data)
            else:
                response = self._response_to(name, data)
            async with asyncio.timeout(self._handler.limits.body_seconds):
                await context.write(response.SerializeToString())
            if name != STREAM_METHOD or self._is_stopping:
                return
            timeout_s = self._handler.limits.idle_seconds
        if name != STREAM_METHOD:
            raise RequestError("expected one message, got none")

    def _response_to(self, name: str, data: bytes) -> Any:
        """Answer one message, and return the response.

        An inference is answered by a model, and any other request as by the HTTP server. In the method `STREAM_METHOD`,
        a response contains either the result of an inference or an error message.

        Args:
            name: Name of the method.
            data: The serialized message of the request.

        Raises:
            RequestError: If the data are not a message of the expected type.
            IsochargeError: If the request is refused.
        """
        request_type, response_type = METHODS[name]
        try:
            request = request_type.FromString(data)
        except DecodeError as error:
            raise RequestError(
                f"expected a {request_type.DESCRIPTOR.name}, got {len(data)} bytes of another kind"
            ) from error
        if name == STREAM_METHOD:
            try:
                return response_type(infer_response=self._infer(request))
            except Exception as error:  # every error is sent to the client, and does not end the stream
                _, message = refusal(error)
                return response_type(error_message=message)
        if name == "ModelInfer":
            return self._infer(request)
        return ParseDict(self._answer_like_http(name, request), response_type())

    def _answer_like_http(self, name: str, request: Any) -> Json:
        """Answer a message with the route of the HTTP server that gives the same answer.

        Args:
            name: Name of the method, which is not a method for inferences.
            request: The message.

        Returns:
            Values of the fields of the response by name.

        Raises:
            IsochargeError: If the request is refused.
        """
        # The name of the model is called `model_name` in the messages that load and unload a model, and `name` in other
        # messages. Messages about the server contain none of these fields.
        model_name = getattr(request, "model_name", "") or getattr(request, "name", "")
        model_version = getattr(request, "version", "")
        # The body contains all fields of the message. The routes read only `ready` (whether an index lists only loaded
        # versions) and `parameters` (of loading a model).
        body = MessageToJson(request).encode()
        equivalent = Request(
            self._handler.store, self._handler.traffic, headers={}, body=body, name=model_name, version=model_version
        )
        try:
            content = ROUTE_OF_METHOD[name].respond(equivalent)
        except ModelError:  # the server or the model is not ready
            if name not in ("ServerReady", "ModelReady"):
                raise
            return {"ready": False}  # gRPC has no status for this answer
        # Some responses have a single field, whose value is the content of the HTTP response.
        return {ANSWER_FIELDS[name]: content} if name in ANSWER_FIELDS else content

    def _infer(self, request: Any) -> Any:
        """Run a model on the charges of a ModelInferRequest, and return the ModelInferResponse."""
        loaded = self._handler.store.get(request.model_name, request.model_version)
        with loaded.statistics.refused.count_exceptions(), loaded.statistics.latency.time():
            content, raw_contents = infer(loaded, *read_request(request))
            return write_response(content, raw_contents)

    def _limit_open_calls(self) -> None:
        """If there are too many open calls, end the call that has waited longest for a message.

        Raises:
            RequestError: If there are too many open calls, and none of them waits for a message.
        """
        if self._open_count <= self._handler.limits.connections:
            return
        oldest_timeout = next(iter(self._waiting_timeouts), None)  # the first element has waited longest
        if oldest_timeout is None:
            raise RequestError(f"all {self._handler.limits.connections} calls are taken; try again later", 429)
        # A timeout with a deadline in the past, such as 0, expires at once, and ends its call. The call counts as open
        # until its coroutine ends. The count may briefly exceed the limit.
        del self._waiting_timeouts[oldest_timeout]
        oldest_timeout.reschedule(0.0)

    def end_streams(self) -> None:
        """End the calls that wait for a message, because the server stops.

        The calls stay open for another 0.1 s, because a client may have sent a message that has not been read yet.
        """
        self._is_stopping = True
        deadline = asyncio.get_running_loop().time() + 0.1
        for timeout in self._waiting_timeouts:
            timeout.reschedule(deadline)

    async def _next_message(self, context: ServicerContext, timeout_s: float) -> Any:
        """Wait for the next message of a call.

        While a call waits for a message, the service may end the call to make room for a new call.

        Args:
            context: Context of the call.
            timeout_s: Longest time to wait, s.

        Returns:
            The serialized message, or `EOF` if the client has ended the call.

        Raises:
            TimeoutError: If the message does not arrive in time, or if the service ends this call because of a new
                call or because the server stops.
        """
        async with asyncio.timeout(timeout_s) as timeout:
            # The dictionary serves as an ordered set. `_limit_open_calls` and `end_streams` may reschedule this timeout
            # so that it expires early.
            self._waiting_timeouts[timeout] = None
            try:
                return await context.read()
            finally:
                self._waiting_timeouts.pop(timeout, None)
