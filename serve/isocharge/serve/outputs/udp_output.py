"""Output that sends each record as a JSON object in its own UDP datagram.

The UDP server of PlotJuggler can receive the records if the protocol of the server is set to JSON. PlotJuggler expects
one JSON object in each datagram. It uses the number `timestamp` as the time, ignores values that are null, and shows
every other number as a time series. The name of a time series is the path of the number in the JSON object, such as
`charge_pC/A`.
"""

import socket
from contextlib import suppress

from isocharge.common.errors import InputError, shown
from isocharge.serve.outputs.output import Output, OutputContext, OutputKind
from isocharge.serve.record.record import PredictionRecord

SCHEME = "udp://"

MAX_PORT = 65535


class UdpOutput:
    """Output that sends each record as a datagram, even if no program receives the datagrams."""

    def __init__(self, address: str) -> None:
        """Resolve the address of the receiver, and open the socket.

        Args:
            address: Address of the receiver in the form `HOST:PORT`.

        Raises:
            InputError: If the address has another form, or the host is unknown.
        """
        host, _, port = address.rpartition(":")
        try:
            is_valid_port = 0 < int(port) <= MAX_PORT  # int raises ValueError if the text is not a number
            if not is_valid_port:
                raise ValueError(f"a port is a number from 1 to {MAX_PORT}")
            first_address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]  # preferred by the system
        except (OSError, ValueError) as error:  # getaddrinfo raises ValueError if a part of the name is too long
            example = f"{SCHEME}127.0.0.1:9870"
            raise InputError(
                f"output {shown(SCHEME + address)}: expected {SCHEME}HOST:PORT, as in {example} ({error})"
            ) from error
        family, _, _, _, socket_address = first_address  # the family is IPv4 or IPv6
        self._address = socket_address
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)  # a live stream must not wait for the network

    def write(self, record: PredictionRecord) -> None:
        """Send a record. If the record cannot be sent at once, drop it, because a live stream never waits."""
        with suppress(OSError):  # the receiver is unreachable, or the buffer is full
            self._socket.sendto(record.to_json().encode(), self._address)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _open_udp(target: str, _: OutputContext) -> Output:  # the output does not depend on the stream
    return UdpOutput(target.removeprefix(SCHEME))


UDP = OutputKind(
    form=f"{SCHEME}HOST:PORT", accepts=lambda target: target.startswith(SCHEME), open=_open_udp, may_block=False
)
