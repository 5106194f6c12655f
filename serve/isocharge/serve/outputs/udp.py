"""Output of records as JSON in UDP datagrams.

The UDP server of PlotJuggler can receive the records if the protocol of the server is set to JSON. PlotJuggler expects
one JSON object in each datagram. PlotJuggler uses the number `timestamp` as the time, ignores values that are null, and
shows every other number as a time series. The name of a time series is the path of the number in the JSON object, such
as `charge_pC/A`.
"""

import socket
from contextlib import suppress
from urllib.parse import urlsplit

from isocharge.common.errors import InputError, shown
from isocharge.serve.outputs.output import OutputKind
from isocharge.serve.record.record import PredictionRecord

SCHEME = "udp://"


class UdpOutput:
    """Output that sends each record as a datagram, even if no program receives the datagrams."""

    def __init__(self, target: str) -> None:
        """Resolve the address of the receiver, and open the socket.

        Args:
            target: Address of the receiver in the form `udp://HOST:PORT`.

        Raises:
            InputError: If the target has another form, or the host is unknown.
        """
        try:
            address = urlsplit(target)
            if not address.hostname or not address.port or address.path:  # `port` raises ValueError if it is no number
                raise ValueError("expected a host and a port")
            first_address = socket.getaddrinfo(address.hostname, address.port, type=socket.SOCK_DGRAM)[0]
        except (OSError, ValueError) as error:  # getaddrinfo raises ValueError if a part of the name is too long
            raise InputError(
                f"output {shown(target)}: expected {SCHEME}HOST:PORT, as in {SCHEME}127.0.0.1:9870 ({error})"
            ) from error
        family, _, _, _, socket_address = first_address  # the address that the system prefers, IPv4 or IPv6
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


UDP = OutputKind(
    form=f"{SCHEME}HOST:PORT",
    accepts=lambda target: target.startswith(SCHEME),
    open=lambda target, _: UdpOutput(target),  # the output does not depend on the stream
)
