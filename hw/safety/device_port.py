"""A device's port as the supervisor opens it, without waiting; how long one that has vanished may come back."""

from __future__ import annotations

import errno
import ipaddress
import os
import select
import socket
import struct
import termios
import time
from collections.abc import Generator
from urllib.parse import urlsplit

import serial

FAILURES = (OSError, termios.error, ValueError)  # of a port; pyserial lets the second through
CONNECT_S = 2.0
NO_LINGER = struct.pack("ii", 1, 0)  # closing frees the number at once
RETURN_S = 600.0  # how long a cable that was pulled may be away
SERVED_S = 10.0  # how long a linked pseudo-terminal may: the program behind it has ended, or is started anew

Port = serial.SerialBase | socket.socket


def opened(url: str, baud: int) -> Generator[None, object, Port]:
    """A port, locked and non-blocking. url: of a path, or `socket://` with an address in numbers (names take time).

    Raises: one of FAILURES.
    """
    if url.startswith("socket://"):
        return (yield from _connected(url))
    port = serial.serial_for_url(url, baudrate=baud, timeout=0, exclusive=True)
    os.set_blocking(port.fileno(), False)
    return port


def _connected(url: str) -> Generator[None, object, socket.socket]:
    parts = urlsplit(url)
    address, end = ipaddress.ip_address(parts.hostname or ""), time.monotonic() + CONNECT_S
    port = socket.socket(socket.AF_INET if address.version == 4 else socket.AF_INET6)
    try:
        port.setblocking(False)
        port.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        failed = port.connect_ex((str(address), parts.port or 0))
        while failed == errno.EINPROGRESS:
            if select.select([], [port], [], 0.0)[1]:
                failed = port.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
            elif time.monotonic() > end:
                failed = errno.ETIMEDOUT
            else:
                yield
        if failed:
            raise OSError(failed, os.strerror(failed))
        if port.getsockname() == port.getpeername():  # nobody listens, and the kernel chose that very number for us
            port.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, NO_LINGER)  # else its server could not have it again
            raise OSError(errno.ECONNREFUSED, os.strerror(errno.ECONNREFUSED))
    except BaseException:
        port.close()
        raise
    return port


def return_s(url: str) -> float:
    """How long an open port may come back once it has vanished, under the same name.

    The number of a pseudo-terminal is given to the next one, whoever opens it: by that it never comes back. A network
    port is a cable, on this machine too: behind 127.0.0.1 there may be a real laser's serial server, or an ssh tunnel.
    """
    if url.startswith("socket://") or not os.path.realpath(url).startswith(("/dev/pts/", "/dev/ttys")):
        return RETURN_S
    return SERVED_S if os.path.islink(url) else 0.0
