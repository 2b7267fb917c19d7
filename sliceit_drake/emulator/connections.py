"""TCP connections of a server that never waits: one thread serves them all between cycles."""

import contextlib
import selectors
import socket
import struct
import time
from functools import partial

__all__ = ["Connection", "Service", "SocketHub", "take_until"]

_RECEIVE = 65536
_LINGER_NOT = struct.pack("ii", 1, 0)


class Connection:
    """A client.

    Attributes:
        service: Service that it has connected to.
        unread: What has come, and the service has not taken yet.
        is_open: Whether anything can still be sent.
    """

    def __init__(self, hub: "SocketHub", sock: socket.socket, service: "Service") -> None:
        self._hub, self._socket, self.service = hub, sock, service
        self._unsent = bytearray()
        self.unread = bytearray()
        self.is_open = True

    @property
    def backlog(self) -> int:
        """Bytes that could not be sent so far."""
        return len(self._unsent)

    def send(self, data: bytes) -> None:
        """Sends all of `data`, now or when the client reads again."""
        if self.is_open:
            self._unsent += data
            self.flush()

    def flush(self) -> None:
        """Sends what the network takes now."""
        while self._unsent and self.is_open and not self._hub.is_silent:
            try:
                sent = self._socket.send(self._unsent)
            except BlockingIOError:
                break
            except OSError:
                self.close()
                return
            del self._unsent[:sent]
        if self.is_open:
            wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if self._unsent else 0)
            if self._hub.selector.get_key(self._socket).events != wanted:
                self._hub.selector.modify(self._socket, wanted, self)

    def close(self, reset: bool = False) -> None:
        """Closes the connection, and tells its service; with `reset` the client sees an error."""
        if not self.is_open:
            return
        self.is_open = False
        self._hub.selector.unregister(self._socket)
        if reset:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_NOT)
        self._socket.close()
        self.service.closed(self)

    def receive(self) -> None:
        """Reads what has come, and hands it to the service."""
        try:
            data = self._socket.recv(_RECEIVE)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self.unread += data
            self.service.received(self)
        else:
            self.close()


class Service:
    """Service that answers on a port."""

    def opened(self, connection: Connection) -> None:
        """A client has connected."""

    def received(self, connection: Connection) -> None:
        """A client has sent some bytes, split anyhow, to `Connection.unread`."""
        raise NotImplementedError

    def closed(self, connection: Connection) -> None:
        """A connection has ended."""


class SocketHub:
    """All ports of one address.

    Attributes:
        selector: What waits for all sockets; the data of a key is its `Connection`, if it is none
            of the ports.
        refuses: While set, new clients are turned away.
        is_silent: While set, nothing is read, sent or accepted: a network that is cut.
    """

    def __init__(self, address: str) -> None:
        self.refuses = self.is_silent = False
        self._address = address
        self.selector = selectors.DefaultSelector()

    def listen(self, port: int, service: Service) -> None:
        """Opens a port.

        Raises:
            OSError: It is taken, or the address is not of this machine.
        """
        sock = socket.socket()
        try:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind((self._address, port))
            sock.listen(8)
        except OSError as error:
            sock.close()
            raise OSError(
                f"cannot listen on {self._address}:{port}: {error.strerror}. Another emulator may "
                "use it: give another --address, such as 127.0.0.2."
            ) from error
        sock.setblocking(False)
        self.selector.register(sock, selectors.EVENT_READ, partial(self._accept, sock, service))

    def connections(self, service: Service | None = None) -> list[Connection]:
        """Clients of a service, or of all."""
        all_data = [key.data for key in self.selector.get_map().values()]
        clients = [data for data in all_data if isinstance(data, Connection)]
        return [c for c in clients if service is None or c.service is service]

    def poll(self, timeout: float) -> None:
        """Serves what is ready, waiting up to `timeout` s for something to be."""
        if self.is_silent:
            time.sleep(max(0.0, timeout))
            return
        for key, events in self.selector.select(max(0.0, timeout)):
            if not isinstance(key.data, Connection):
                key.data()
                continue
            if events & selectors.EVENT_WRITE:
                key.data.flush()
            if events & selectors.EVENT_READ and key.data.is_open:
                key.data.receive()

    def close(self) -> None:
        """Closes all ports and connections."""
        for connection in self.connections():
            connection.close()
        for key in self.selector.get_map().values():
            assert isinstance(key.fileobj, socket.socket)
            key.fileobj.close()
        self.selector.close()

    def _accept(self, listener: socket.socket, service: Service) -> None:
        try:
            sock, _ = listener.accept()
        except OSError:
            return  # The client has given up meanwhile.
        if self.refuses:
            sock.close()
            return
        sock.setblocking(False)
        with contextlib.suppress(OSError):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection = Connection(self, sock, service)
        self.selector.register(sock, selectors.EVENT_READ, connection)
        service.opened(connection)


def take_until(buffer: bytearray, end: bytes) -> bytes | None:
    """Takes what comes first, up to and with `end`; None, and nothing, while there is no end."""
    place = buffer.find(end)
    if place < 0:
        return None
    taken = bytes(buffer[: place + len(end)])
    del buffer[: len(taken)]
    return taken
