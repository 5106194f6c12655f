"""Output of records as UDP datagrams. Each datagram contains one JSON object.

The UDP server of PlotJuggler with the JSON protocol can read the records without a conversion. PlotJuggler expects one
object in each datagram, and uses the number `timestamp` as the time. Nulls are ignored. Each other number is shown as a
series under the path to the number, such as `charge_pC/A`.
"""

import socket
from contextlib import suppress

from isocharge.common.errors import InputError, shown
from isocharge.serve.outputs.output import Output, OutputContext, OutputKind
from isocharge.serve.record.record import PredictionRecord

SCHEME = "udp://"

MAX_PORT = 65535


class UdpOutput:
    """Sends each record as a datagram. A program need not receive the datagram."""

    def __init__(self, address: str) -> None:
        """Look up the receiver, and open the socket.

        Args:
            address: `HOST:PORT`.

        Raises:
            InputError: If the address has another form, or the host is unknown.
        """
        host, _, port = address.rpartition(":")
        try:
            if not 0 < int(port) <= MAX_PORT:  # int raises ValueError if this is no number
                raise ValueError(f"a port is a number from 1 to {MAX_PORT}")
            first_address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
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
        """Send a record. If the network is not ready, drop the record, because a live stream never waits."""
        with suppress(OSError):  # the receiver is unreachable, or the buffer is full
            self._socket.sendto(record.to_json().encode(), self._address)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def _open_udp(target: str, _: OutputContext) -> Output:
    return UdpOutput(target.removeprefix(SCHEME))


UDP = OutputKind(
    form=f"{SCHEME}HOST:PORT", accepts=lambda target: target.startswith(SCHEME), open=_open_udp, may_block=False
)
