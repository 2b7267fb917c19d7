"""TCP connections of a server that never waits: one thread serves them all between cycles."""

import contextlib
import selectors
import socket
import struct
import time
from typing import Protocol

__all__ = ["Connection", "Service", "SocketHub"]

_RECEIVE = 65536
_LINGER_NOT = struct.pack("ii", 1, 0)


class Connection:
    """A client.

    Attributes:
        peer: Address and port of the client.
        is_open: Whether anything can still be sent.
    """

    def __init__(self, hub: "SocketHub", sock: socket.socket, service: "Service") -> None:
        self._hub, self._socket, self._service = hub, sock, service
        self._unsent = bytearray()
        self.peer = sock.getpeername()
        self.is_open = True

    @property
    def backlog(self) -> int:
        """Bytes that could not be sent so far."""
        return len(self._unsent)

    def send(self, data: bytes) -> None:
        """Sends all of `data`, now or when the client reads again."""
        if not self.is_open:
            return
        self._unsent += data
        if not self._hub.is_silent:
            self.flush()

    def flush(self) -> None:
        """Sends what the network takes now."""
        while self._unsent and self.is_open:
            try:
                sent = self._socket.send(self._unsent)
            except BlockingIOError:
                break
            except OSError:
                self.close()
                return
            del self._unsent[:sent]
        if self.is_open:
            self._hub.watch(self)

    def close(self, reset: bool = False) -> None:
        """Closes the connection, and tells its service; with `reset` the client sees an error."""
        if not self.is_open:
            return
        self.is_open = False
        self._hub.forget(self)
        if reset:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _LINGER_NOT)
        self._socket.close()
        self._service.closed(self)

    def fileno(self) -> int:
        """File descriptor for the selector."""
        return self._socket.fileno()

    def receive(self) -> None:
        """Reads what has come, and hands it to the service."""
        try:
            data = self._socket.recv(_RECEIVE)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._service.received(self, data)
        else:
            self.close()


class Service(Protocol):
    """Service that answers on a port."""

    def opened(self, connection: Connection) -> None:
        """A client has connected."""

    def received(self, connection: Connection, data: bytes) -> None:
        """A client has sent some bytes, split anyhow."""

    def closed(self, connection: Connection) -> None:
        """A connection has ended."""


class SocketHub:
    """All ports of one address.

    Attributes:
        refuses: While set, new clients are turned away.
    """

    def __init__(self, address: str) -> None:
        self.refuses = self._is_silent = False
        self._address = address
        self._selector = selectors.DefaultSelector()
        self._listeners: dict[socket.socket, Service] = {}
        self._connections: dict[Connection, Service] = {}

    @property
    def is_silent(self) -> bool:
        """While set, nothing is read, sent or accepted: a network that is cut."""
        return self._is_silent

    @is_silent.setter
    def is_silent(self, value: bool) -> None:
        self._is_silent = value
        if not value:
            for connection in list(self._connections):
                connection.flush()

    def listen(self, port: int, service: Service) -> None:
        """Opens a port.

        Raises:
            OSError: It is taken, or the address is not of this machine.
        """
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind((self._address, port))
            sock.listen(8)
            sock.setblocking(False)
        except OSError as error:
            sock.close()
            raise OSError(
                f"cannot listen on {self._address}:{port}: {error.strerror}. Another emulator may "
                "use it: give another --address, such as 127.0.0.2."
            ) from error
        self._listeners[sock] = service
        self._selector.register(sock, selectors.EVENT_READ)

    def connections(self, service: Service) -> list[Connection]:
        """Clients of a service."""
        return [c for c, its_service in self._connections.items() if its_service is service]

    def poll(self, timeout: float) -> None:
        """Serves what is ready, waiting up to `timeout` s for something to be."""
        if self.is_silent:
            time.sleep(max(0.0, timeout))
            return
        for key, events in self._selector.select(max(0.0, timeout)):
            if isinstance(key.fileobj, Connection):
                if events & selectors.EVENT_WRITE:
                    key.fileobj.flush()
                if events & selectors.EVENT_READ and key.fileobj.is_open:
                    key.fileobj.receive()
            else:
                assert isinstance(key.fileobj, socket.socket)
                self._accept(key.fileobj)

    def watch(self, connection: Connection) -> None:
        """Waits for a connection to be readable, and writable if it has something to send."""
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if connection.backlog else 0)
        if self._selector.get_key(connection).events != wanted:
            self._selector.modify(connection, wanted)

    def forget(self, connection: Connection) -> None:
        """Stops waiting for a connection that is about to close."""
        self._selector.unregister(connection)
        del self._connections[connection]

    def close(self) -> None:
        """Closes all ports and connections."""
        for connection in list(self._connections):
            connection.close()
        for sock in self._listeners:
            self._selector.unregister(sock)
            sock.close()
        self._listeners.clear()
        self._selector.close()

    def _accept(self, listener: socket.socket) -> None:
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
        try:
            connection = Connection(self, sock, self._listeners[listener])
        except OSError:
            sock.close()
            return
        self._connections[connection] = self._listeners[listener]
        self._selector.register(connection, selectors.EVENT_READ)
        self._listeners[listener].opened(connection)
