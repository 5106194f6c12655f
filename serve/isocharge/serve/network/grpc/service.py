"""gRPC server: `inference.GRPCInferenceService` with the models, limits, token and certificate of the HTTP server.

The server runs in its own event loop, and an open call needs no thread, so that idle calls do not delay other clients.
All methods are declared as streams of messages from the client. The token and the limits can therefore be checked
before the first message arrives. If the largest number of calls is open, a new call replaces the call that has waited
longest for a message from its client.

The message classes are built from the compiled `inference.proto` in a separate descriptor pool, so that a program may
also use another implementation of the protocol, whose messages have the same names.
"""

import asyncio
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from threading import Thread
from typing import Any

import grpc
import grpc.aio
import uvloop
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.json_format import ParseDict
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from isocharge.common.errors import ListenError, RequestError, TooMany
from isocharge.serve.network.address import ServerLimits, Tls
from isocharge.serve.network.model_store import LoadedVersion
from isocharge.serve.network.protocol import Handler, describe
from isocharge.serve.network.protocol.inference import (
    FLAGS,
    InferAnswer,
    InferRequest,
    answer_inference,
    binary_tensor,
    parse_request,
)
from isocharge.serve.network.protocol.response import client_message, statuses
from isocharge.serve.network.traffic import Exchange

SERVICE = "inference.GRPCInferenceService"
"""Full name of the service."""


def _service_descriptor() -> Any:
    """Return the descriptor of the service from the compiled protocol file."""
    compiled = files("isocharge.serve.network.grpc").joinpath("inference.binpb").read_bytes()
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(compiled).file:
        pool.Add(file)
    return pool.FindServiceByName(SERVICE)


METHODS: dict[str, tuple[type[Any], type[Any]]] = {
    method.name: (GetMessageClass(method.input_type), GetMessageClass(method.output_type))
    for method in _service_descriptor().methods
}
"""Classes of the request and of the response of each method, by its name."""

CONTENT_FIELDS = {"FP32": "fp32_contents", "FP64": "fp64_contents"}
"""Field of a tensor's contents that holds the numbers, by number type."""


def read_request(message: Any, loaded: LoadedVersion, batch: int) -> InferRequest:
    """Parse a ModelInferRequest, and return the charges and the requested outputs.

    If the charges are raw contents, the outputs are sent as raw contents, too.

    Args:
        message: The message.
        loaded: The model.
        batch: Largest number of presses in one request.

    Raises:
        RequestError: If the message is not a request for this model.
        ChargeError: If a charge is not finite.
        TooLarge: If there are more presses than `batch`.
    """
    raw_contents = message.raw_input_contents
    if len(raw_contents) > 1:
        raise RequestError(f"expected one input tensor, got {len(raw_contents)} raw contents")
    raw = raw_contents[0] if raw_contents else None
    content = {
        "id": message.id,
        "inputs": [_input_object(tensor, raw) for tensor in message.inputs],
        "outputs": [{"name": output.name, "parameters": _unsupported_parameters(output)} for output in message.outputs],
        "parameters": {"binary_data_output": raw is not None},
    }
    return parse_request(content, raw or b"", loaded, batch)


def _input_object(tensor: Any, raw: bytes | None) -> dict[str, Any]:
    """Return an input tensor as the JSON object of the HTTP protocol.

    Args:
        tensor: Message with the name, the number type and the shape of the tensor, and possibly its numbers.
        raw: Raw content of the message, which follows the JSON text in the HTTP protocol; None if there is none.
    """
    parameters: dict[str, Any] = _unsupported_parameters(tensor)
    content = {"name": tensor.name, "datatype": tensor.datatype, "shape": list(tensor.shape), "parameters": parameters}
    if raw is not None:
        parameters["binary_data_size"] = len(raw)
    if tensor.HasField("contents") or raw is None:
        field = CONTENT_FIELDS.get(tensor.datatype, "fp32_contents")
        content["data"] = list(getattr(tensor.contents, field))
    return content


def _unsupported_parameters(tensor: Any) -> dict[str, bool]:
    """Return the parameters of a tensor that this server must refuse, because they change the meaning of a request."""
    return {name: True for name in ("shared_memory_region", "classification") if name in tensor.parameters}


def write_response(answer: InferAnswer) -> Any:
    """Return the outputs of a model as a ModelInferResponse."""
    _, response_type = METHODS["ModelInfer"]
    message = response_type()
    message.model_name = answer.name
    message.model_version = answer.version
    message.id = answer.id
    for name, rows in answer.outputs.items():
        is_text = name == FLAGS
        tensor = message.outputs.add(name=name, datatype="BYTES" if is_text else "FP32", shape=rows.shape)
        if name in answer.binary:
            message.raw_output_contents.append(binary_tensor(rows))
        elif is_text:
            tensor.contents.bytes_contents.extend(text.encode() for text in rows[:, 0].tolist())
        else:
            tensor.contents.fp32_contents.extend(rows.ravel().tolist())
    return message


METHODS_WITHOUT_TOKEN = ("ServerLive", "ServerReady")
"""Methods that need no token."""

SLOW_METHODS = ("RepositoryModelLoad", "RepositoryModelUnload")
"""Methods that may take long and are answered in other threads."""

STREAM = "ModelStreamInfer"
"""Name of the method that receives and sends many messages."""


@dataclass
class _Call:
    """Properties of a call for counters and log.

    Attributes:
        model: Label `name/version` of the requested model; None if the call names no model.
        bytes_in: Total size of the received messages, bytes.
        bytes_out: Total size of the sent messages, bytes.
    """

    model: str | None = None
    bytes_in: int = 0
    bytes_out: int = 0


class Service:
    """Answers calls with the models, the token and the limits of a handler."""

    def __init__(self, handler: Handler) -> None:
        """Register the function that answers each method.

        Args:
            handler: Handler of the HTTP server, whose models, limits, token and counters are used.
        """
        store = handler.store
        self._store = store
        self._limits = handler.limits
        self._traffic = handler.traffic
        self._token = handler.token
        self._open_calls = 0
        self._waiting: dict[asyncio.Timeout, None] = {}  # an ordered set of the calls that wait for a message
        self._traffic.open["grpc"] = lambda: self._open_calls
        self._answers: dict[str, Callable[[Any], Any]] = {
            "ServerLive": lambda _: {"live": True},
            "ServerReady": lambda _: {"ready": bool(store.loaded_versions())},
            "ModelReady": lambda request: {"ready": store.label(request.name, request.version) is not None},
            "ServerMetadata": lambda _: describe.server_metadata(),
            "ModelMetadata": lambda request: describe.model_metadata(store.get(request.name, request.version), store),
            "ModelConfig": lambda request: {
                "config": describe.model_config(store.get(request.name, request.version), self._limits)
            },
            "ModelStatistics": lambda request: describe.statistics_of(store, request.name, request.version),
            "RepositoryIndex": lambda request: {"models": describe.repository_index(store, ready=request.ready)},
            "RepositoryModelLoad": self._load,
            "RepositoryModelUnload": lambda request: store.unload(request.model_name),
            "ModelInfer": self._infer,
            STREAM: self._infer_in_stream,
        }

    def handlers(self) -> grpc.GenericRpcHandler:
        """Return the handlers of all methods for grpcio."""
        methods = {name: grpc.stream_unary_rpc_method_handler(partial(self._handle, name)) for name in METHODS}
        methods[STREAM] = grpc.stream_stream_rpc_method_handler(partial(self._handle, STREAM))
        return grpc.method_handlers_generic_handler(SERVICE, methods)

    async def _handle(self, name: str, _: object, context: grpc.aio.ServicerContext) -> Any:
        """Answer a call, and count it with its status and its error.

        Args:
            name: Name of the method.
            context: Context of the call, from which messages are read.

        Returns:
            The response; None for the method `STREAM`, whose responses have been sent. If an error occurs, the call is
            ended with the status and the message of the error.
        """
        call = _Call()
        start_ns = time.perf_counter_ns()
        status = "CANCELLED"  # stays if the client disconnects
        error_type = None
        try:
            result = await self._answer_call(name, context, call)
            status = "OK"
            return result
        except TimeoutError as error:
            status = "DEADLINE_EXCEEDED"
            error_type = type(error).__name__
            message = "the call waited too long for its client, or others needed its place"
        except Exception as error:  # every error is sent to the client
            _, status = statuses(error)
            error_type = type(error).__name__
            message = client_message(error)
        finally:
            self._traffic.note(
                Exchange(
                    transport="grpc",
                    route=name,
                    status=status,
                    model=call.model,
                    error=error_type,
                    ns=time.perf_counter_ns() - start_ns,
                    bytes_in=call.bytes_in,
                    bytes_out=call.bytes_out,
                    client=context.peer() if self._traffic.log else None,
                )
            )
        return await context.abort(grpc.StatusCode[status], message)

    async def _answer_call(self, name: str, context: grpc.aio.ServicerContext, call: _Call) -> bytes | None:
        """Check the number of calls and the token, and answer the messages of a call.

        Args:
            name: Name of the method.
            context: Context of the call.
            call: Properties of the call for counters and log.

        Returns:
            The response; None for the method `STREAM`, whose responses have been sent.
        """
        with self._open_call():
            if self._token is not None and name not in METHODS_WITHOUT_TOKEN:
                self._token.check(_authorization(context))
            if name == STREAM:
                await self._answer_stream(context, call)
                return None
            return await self._answer_message(name, context, call)

    async def _answer_message(self, name: str, context: grpc.aio.ServicerContext, call: _Call) -> bytes:
        """Return the serialized response to the only message of a call.

        Args:
            name: Name of the method.
            context: Context of the call, from which the message is read.
            call: Properties of the call for counters and log.

        Raises:
            RequestError: If the call ends without a message, or the message is not valid.
            TimeoutError: If the message does not arrive in time.
        """
        data = await self._next_message(context, self._limits.header_seconds)
        if data is grpc.aio.EOF:
            raise RequestError(f"{name}: expected a message, got none")
        if name in SLOW_METHODS:
            return await asyncio.to_thread(self._answer, name, data, call)
        return self._answer(name, data, call)

    async def _answer_stream(self, context: grpc.aio.ServicerContext, call: _Call) -> None:
        """Send a response to each message of a stream.

        Args:
            context: Context of the call, from which messages are read and to which responses are written.
            call: Properties of the call for counters and log.

        Raises:
            TimeoutError: If the client sends no message, or does not read a response, in time.
        """
        timeout_s = self._limits.header_seconds
        while (data := await self._next_message(context, timeout_s)) is not grpc.aio.EOF:
            async with asyncio.timeout(self._limits.body_seconds):
                await context.write(self._answer(STREAM, data, call))
            timeout_s = self._limits.idle_seconds

    def _answer(self, name: str, data: bytes, call: _Call) -> bytes:
        """Return the serialized response to a serialized message.

        Args:
            name: Name of the method.
            data: The serialized request.
            call: Properties of the call, to which the model and the sizes of request and response are added.
        """
        request_type, response_type = METHODS[name]
        call.bytes_in += len(data)
        try:
            request = request_type.FromString(data)
        except DecodeError as error:
            expected = request_type.DESCRIPTOR.name
            raise RequestError(f"expected a {expected}, got {len(data)} bytes of another kind") from error
        # The messages of the protocol have different names for the fields with the model and its version.
        model_name = getattr(request, "model_name", "") or getattr(request, "name", "")
        model_version = getattr(request, "model_version", "") or getattr(request, "version", "")
        call.model = self._store.label(model_name, model_version)

        answer = self._answers[name](request)
        response = answer if isinstance(answer, Message) else ParseDict(answer or {}, response_type())
        response_data: bytes = response.SerializeToString()
        call.bytes_out += len(response_data)
        return response_data

    def _load(self, request: Any) -> None:
        """Read the files of a model again; raise RequestError if the request has parameters."""
        if request.parameters:
            raise RequestError(describe.NO_LOAD_PARAMETERS)
        self._store.load(request.model_name)

    def _infer(self, request: Any) -> Any:
        """Return the ModelInferResponse to a ModelInferRequest."""
        loaded = self._store.get(request.model_name, request.model_version)
        read = partial(read_request, request, loaded, self._limits.batch)
        return answer_inference(loaded, read, write_response)

    def _infer_in_stream(self, request: Any) -> Any:
        """Return the response to one request of a stream.

        If an error occurs, its message is returned as a response, so that the stream continues.
        """
        _, response_type = METHODS[STREAM]
        try:
            response = response_type(infer_response=self._infer(request))
            status = "OK"
        except Exception as error:
            response = response_type(error_message=client_message(error))
            _, status = statuses(error)
        self._traffic.count("grpc", f"{STREAM} message", status)
        return response

    @contextmanager
    def _open_call(self) -> Iterator[None]:
        """Count an open call. If there are too many calls, end the call that has waited longest for a message.

        Raises:
            TooMany: If there are too many calls, and no call waits for a message.
        """
        if self._open_calls >= self._limits.connections:
            if not self._waiting:
                raise TooMany(f"all {self._limits.connections} calls are taken; try again later")
            oldest = next(iter(self._waiting))
            del self._waiting[oldest]
            oldest.reschedule(asyncio.get_running_loop().time())
        self._open_calls += 1
        try:
            yield
        finally:
            self._open_calls -= 1

    async def _next_message(self, context: grpc.aio.ServicerContext, timeout_s: float) -> Any:
        """Wait for the next message of a call, and return it; return grpc.aio.EOF at the end of the call.

        While the call waits, a new call may replace it.

        Args:
            context: Context of the call.
            timeout_s: Longest time to wait, s.

        Raises:
            TimeoutError: If the message does not arrive in time, or a new call replaces this call.
        """
        async with asyncio.timeout(timeout_s) as timeout:
            self._waiting[timeout] = None
            try:
                return await context.read()
            finally:
                self._waiting.pop(timeout, None)


def _authorization(context: grpc.aio.ServicerContext) -> bytes:
    """Return the value of the metadata field `authorization`; empty if the client did not send this field."""
    value = dict(context.invocation_metadata() or ()).get("authorization", "")
    return value.encode() if isinstance(value, str) else bytes(value)


GRACE_SECONDS = 10
"""Time that requests which have begun have to finish when the server stops, s."""

MAX_CALLS_PER_CONNECTION = 100
"""Largest number of open calls of one connection, which is the smallest number that HTTP/2 recommends. Further calls
wait on the side of the client."""


@contextmanager
def grpc_server(handler: Handler, host: str, port: int, tls: Tls | None = None) -> Iterator[str]:
    """Run a gRPC server while the block runs.

    Args:
        handler: Handler of the HTTP server, whose models, limits and token are used. Clients send the token as metadata
            `authorization`.
        host: Name or address on which to listen.
        port: TCP port; 0 selects a free port.
        tls: Certificate and key; None for no TLS.

    Yields:
        The address, `grpc://host:port` or `grpcs://host:port`.

    Raises:
        ListenError: If the address is in use or cannot be used.
        InputError: If a TLS file cannot be used.
    """
    with _event_loop() as loop:

        def run(coroutine: Coroutine[Any, Any, Any]) -> Any:
            """Run a coroutine in the event loop of the server, and return its result."""
            return asyncio.run_coroutine_threadsafe(coroutine, loop).result()

        url_host = f"[{host}]" if ":" in host else host
        server, actual_port = run(_start(handler, f"{url_host}:{port}", tls))
        scheme = "grpcs" if tls else "grpc"
        try:
            yield f"{scheme}://{url_host}:{actual_port}"
        finally:
            run(server.stop(GRACE_SECONDS))


@contextmanager
def _event_loop() -> Iterator[asyncio.AbstractEventLoop]:
    """Run an event loop in its own thread while the block runs."""
    loop = uvloop.new_event_loop()
    thread = Thread(target=loop.run_forever, name="grpc")
    thread.start()
    try:
        yield loop
    finally:
        asyncio.run_coroutine_threadsafe(loop.shutdown_default_executor(), loop).result()
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


async def _start(handler: Handler, address: str, tls: Tls | None) -> tuple[grpc.aio.Server, int]:
    """Start a server, and return it with the port on which it listens.

    Args:
        handler: Handler of the HTTP server.
        address: `host:port`; the port 0 selects a free port.
        tls: Certificate and key; None for no TLS.
    """
    limits = handler.limits
    server = grpc.aio.server(options=_options(limits), maximum_concurrent_rpcs=2 * limits.connections)
    server.add_generic_rpc_handlers((Service(handler).handlers(),))
    port = _listen(server, address, tls)
    await server.start()
    return server, port


def _options(limits: ServerLimits) -> list[tuple[str, int]]:
    """Return the options of grpcio that apply the limits of a server."""
    return [
        ("grpc.max_receive_message_length", limits.body_bytes),
        ("grpc.max_metadata_size", limits.header_bytes),
        ("grpc.absolute_max_metadata_size", limits.header_bytes),
        ("grpc.max_concurrent_streams", MAX_CALLS_PER_CONNECTION),
        ("grpc.max_allowed_incoming_connections", limits.connections),
        ("grpc.server_handshake_timeout_ms", round(1e3 * limits.header_seconds)),
        ("grpc.max_connection_idle_ms", round(1e3 * limits.idle_seconds)),
        ("grpc.so_reuseport", 0),
    ]


def _listen(server: grpc.aio.Server, address: str, tls: Tls | None) -> int:
    """Let a server listen on `host:port`, and return the port on which it listens.

    Args:
        server: The server, which has not been started.
        address: `host:port`; the port 0 selects a free port.
        tls: Certificate and key; None for no TLS.

    Raises:
        ListenError: If the address is in use or cannot be used.
        InputError: If a TLS file cannot be used.
    """
    try:
        if tls is None:
            return int(server.add_insecure_port(address))
        credentials = grpc.ssl_server_credentials([tls.key_and_certificate()])
        return int(server.add_secure_port(address, credentials))
    except RuntimeError as error:
        raise ListenError(
            f"cannot listen on {address} for gRPC: {error}; choose another --grpc-port or --host"
        ) from error
