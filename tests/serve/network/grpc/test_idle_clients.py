"""Clients that open calls and say nothing: refused or bounded by what their metadata say, they hold nobody up."""

import itertools
import time
from contextlib import ExitStack
from threading import Event

import grpc
import pytest

from isocharge.serve.network.credentials import Token
from isocharge.serve.network.grpc import grpc_server
from isocharge.serve.network.grpc.messages import METHODS, SERVICE
from isocharge.serve.network.limits import ServerLimits
from isocharge.serve.network.protocol import Handler

pytestmark = pytest.mark.xdist_group("clock")


@pytest.fixture
def serve(store):
    """Start servers with limits of the test's; a function that makes channels to them."""
    with ExitStack() as stack:

        def start(token=None, **limits):
            handler = Handler(store, ServerLimits(**limits), token=token)
            url = stack.enter_context(grpc_server(handler, "127.0.0.1", 0)).removeprefix("grpc://")
            # a separate connection for each channel
            return lambda: stack.enter_context(grpc.insecure_channel(url, [("grpc.use_local_subchannel_pool", 1)]))

        yield start


@pytest.fixture
def silent_call():
    """Open calls of a method whose client sends nothing until the test ends."""
    over = Event()

    def open_call(channel, name, messages=()):
        method = channel.stream_stream(
            f"/{SERVICE}/{name}",
            request_serializer=lambda message: message if isinstance(message, bytes) else message.SerializeToString(),
            response_deserializer=METHODS[name][1].FromString,
        )
        return method(itertools.chain(messages, (over.wait() for _ in range(1) if not over.wait())))

    yield open_call
    over.set()


def is_served(channel):
    method = channel.unary_unary(
        f"/{SERVICE}/ServerMetadata", response_deserializer=METHODS["ServerMetadata"][1].FromString
    )
    return method(b"", timeout=60).name == "isocharge"


def refusal(call):
    with pytest.raises(grpc.RpcError) as caught:
        next(call)
    return caught.value.code().name


def test_no_token_no_stream(serve, silent_call):
    """The token is in the metadata: no message need come for a refusal."""
    connect = serve(token=Token("sesame"))
    channel = connect()
    assert [refusal(silent_call(channel, "ModelStreamInfer")) for _ in range(8)] == ["UNAUTHENTICATED"] * 8
    assert [refusal(silent_call(channel, "ModelInfer")) for _ in range(8)] == ["UNAUTHENTICATED"] * 8


@pytest.mark.parametrize("name", ["ModelStreamInfer", "ModelInfer", "ServerLive", "RepositoryModelLoad"])
def test_silent_calls_hold_nobody_up(serve, silent_call, name):
    connect = serve()
    channel = connect()
    calls = [silent_call(channel, name) for _ in range(50)]
    assert is_served(channel)
    assert is_served(connect())
    assert not any(call.done() for call in calls)


@pytest.mark.parametrize(("name", "messages"), [("ModelInfer", 0), ("ModelStreamInfer", 0), ("ModelStreamInfer", 1)])
def test_silent_calls_are_closed(serve, silent_call, name, messages):
    """Within the time for headers if no message came, and within that between requests if one did."""
    connect = serve(header_seconds=0.3, idle_seconds=0.3)
    call = silent_call(connect(), name, [METHODS[name][0]()] * messages)
    for _ in range(messages):
        assert "is not found" in next(call).error_message
    assert refusal(call) == "DEADLINE_EXCEEDED"


def test_whoever_waits_longest_gives_its_place(serve, silent_call):
    connect = serve(connections=5)
    silent, busy = connect(), connect()
    calls = [silent_call(silent, "ModelStreamInfer") for _ in range(5)]
    time.sleep(0.3)
    assert all(is_served(busy) for _ in range(3))
    deadline = time.monotonic() + 60.0
    while not any(call.done() for call in calls) and time.monotonic() < deadline:
        time.sleep(0.01)  # the client learns of it a moment later
    assert refusal(next(call for call in calls if call.done())) == "DEADLINE_EXCEEDED"
    assert not all(call.done() for call in calls)


def test_messages_that_are_none(serve, silent_call):
    """The client's mistake, not the server's."""
    channel = serve()()
    assert refusal(silent_call(channel, "ModelInfer", [b"\xff\xff\xff"])) == "INVALID_ARGUMENT"
    assert refusal(silent_call(channel, "ModelStreamInfer", [b"\xff\xff\xff"])) == "INVALID_ARGUMENT"
    unary = channel.stream_unary(f"/{SERVICE}/ServerLive")
    with pytest.raises(grpc.RpcError, match="expected a message, got none"):
        unary(iter(()), timeout=60)
