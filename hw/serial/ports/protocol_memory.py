"""pyserial's handler of `memory://NAME`: a port whose other end is an object of this process.

Emulated devices and replayed logs attach themselves here, so that drivers open them as they open any port: by
`serial.serial_for_url`. The peer waits, on its own clock.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from serial import PortNotOpenError, SerialBase, SerialException

PREFIX = "memory://"


class Peer(Protocol):
    """The device at the other end of a port. Raises OSError where a real port would: when it is unplugged."""

    def opened(self) -> None:
        """The port was opened: some devices reset."""

    def closed(self) -> None: ...

    def receive(self, data: bytes) -> None:
        """Bytes from the computer."""

    def deliver(self, size: int, timeout_s: float) -> bytes:
        """At most `size` bytes to the computer; waits for the first of them for at most `timeout_s`."""

    def waiting(self) -> int:
        """How many bytes have arrived and not been read."""


_PEERS: dict[str, Peer] = {}


def attach(name: str, peer: Peer) -> str:
    """Make a peer reachable; returns its URL. A name that is taken changes its owner (another device is plugged in)."""
    _PEERS[name.lower()] = peer
    return PREFIX + name.lower()


class MemoryPort(SerialBase):
    """The computer's end of a memory port."""

    _peer: Peer | None = None

    def open(self) -> None:
        """Find the peer and notify it."""
        peer = _PEERS.get(str(self.port).removeprefix(PREFIX))
        if peer is None:
            raise SerialException(f"nothing is attached to {self.port}")
        try:
            peer.opened()
        except OSError as error:
            raise SerialException(str(error)) from error
        self._peer, self.is_open = peer, True

    def close(self) -> None:
        """Notify the peer; a second time does nothing."""
        peer, self._peer, self.is_open = self._peer, None, False
        if peer is not None:
            peer.closed()

    @contextmanager
    def _use(self) -> Iterator[Peer]:
        """The peer. A port that has failed once stays dead until it is opened again."""
        if self._peer is None:
            raise PortNotOpenError
        try:
            yield self._peer
        except OSError as error:
            self._peer, self.is_open = None, False
            raise SerialException(str(error)) from error

    @property
    def in_waiting(self) -> int:
        """Bytes that can be read without waiting."""
        with self._use() as peer:
            return peer.waiting()

    def read(self, size: int = 1, /) -> bytes:
        """At most `size` bytes within the port's timeout."""
        with self._use() as peer:
            return peer.deliver(size, self.timeout or 0.0)

    def write(self, data: bytes, /) -> int:  # type: ignore[override]
        """Hand over all bytes."""
        with self._use() as peer:
            peer.receive(bytes(data))
        return len(data)


def serial_class_for_url(url: str) -> tuple[str, type[MemoryPort]]:
    """What `serial.serial_for_url` asks a handler for."""
    return url.lower(), MemoryPort
