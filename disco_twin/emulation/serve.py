"""Emulated devices for other programs: on pseudo-terminals (the default) or TCP, served by one thread, in real time.

A pseudo-terminal has no baud rate, so the cable adds the delay, and it does not report its opening: unlike a real
board, an emulated one is not reset by that. On TCP a connection is an opening.
"""

from __future__ import annotations

import logging
import os
import pty
import selectors
import socket
import threading
import tty
from collections.abc import Mapping
from pathlib import Path
from typing import Self

from disco_twin.firmware.wire import Cable

log = logging.getLogger(__name__)

IDLE_S = 0.02


class PtyPort:
    """A pseudo-terminal with a name of its own: a link in a folder. `fd` is what is read and written, and watched."""

    def __init__(self, cable: Cable, link: Path) -> None:
        self.cable, self.link = cable, link
        self.fd, self._slave = pty.openpty()  # the slave stays open: without it the master fails between two users
        tty.setraw(self._slave)
        os.set_blocking(self.fd, False)
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self._slave))
        self.url, self.source = str(link), self.fd
        cable.opened()

    def ready(self, fd: int, selector: selectors.BaseSelector) -> None:
        """Bytes from the user."""
        self.cable.receive(os.read(self.fd, 4096))

    def close(self) -> None:
        """Unplug: the user's reads and writes fail from now on."""
        for fd in (self.fd, self._slave):
            os.close(fd)
        self.fd = -1
        self.link.unlink(missing_ok=True)


class TcpPort:
    """A port of 127.0.0.1; one user at a time. `source` is watched for users; `fd` is -1 while nobody is connected."""

    def __init__(self, cable: Cable) -> None:
        self.cable = cable
        self._server = socket.create_server(("127.0.0.1", 0))
        self.source = self._server.fileno()
        self._user: socket.socket | None = None
        self.fd = -1
        self.url = f"socket://127.0.0.1:{self._server.getsockname()[1]}"

    def ready(self, fd: int, selector: selectors.BaseSelector) -> None:
        """A user, or bytes from the user."""
        if fd == self.source:
            user, _ = self._server.accept()
            self._hang_up(selector)
            user.setblocking(False)
            self._user, self.fd = user, user.fileno()
            selector.register(user, selectors.EVENT_READ, self)
            self.cable.opened()
            return
        try:
            data = os.read(fd, 4096)
        except ConnectionError as error:
            log.debug("%s: %s", self.url, error)
            data = b""
        if data:
            self.cable.receive(data)
        else:
            self._hang_up(selector)

    def _hang_up(self, selector: selectors.BaseSelector) -> None:
        if self._user is not None:
            selector.unregister(self._user)
            self._user.close()
            self.cable.closed()
        self._user, self.fd = None, -1

    def close(self) -> None:
        """No more users."""
        if self._user is not None:
            self._user.close()
        self._server.close()
        self.fd = -1


class Server:
    """Serves cables between `__enter__` and `__exit__`; `urls` by name. `folder`: of the terminals, None for TCP."""

    def __init__(self, cables: Mapping[str, Cable], folder: Path | None) -> None:
        self._cables, self._folder = dict(cables), folder
        self._ports: dict[str, PtyPort | TcpPort] = {}
        self._selector = selectors.DefaultSelector()
        self._lock, self._end = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._serve, name="emulated devices", daemon=True)

    def __enter__(self) -> Self:
        for name in self._cables:
            self.plug(name)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._end.set()
        self._thread.join()
        for port in self._ports.values():
            port.close()
        self._selector.close()

    @property
    def urls(self) -> dict[str, str]:
        """Where the devices are."""
        return {name: port.url for name, port in self._ports.items()}

    def plug(self, name: str) -> None:
        """Plug a device in; a terminal keeps its link's name, a TCP port gets a new number."""
        with self._lock:
            cable = self._cables[name]
            cable.plug()
            port = TcpPort(cable) if self._folder is None else PtyPort(cable, self._folder / name)
            self._selector.register(port.source, selectors.EVENT_READ, port)
            self._ports[name] = port

    def unplug(self, name: str) -> None:
        """Pull a device's cable."""
        with self._lock:
            port = self._ports.pop(name)
            for key in [k for k in self._selector.get_map().values() if k.data is port]:
                self._selector.unregister(key.fileobj)
            port.close()
            self._cables[name].unplug()

    def _serve(self) -> None:
        while not self._end.is_set():
            events = self._selector.select(self._pause())
            with self._lock:
                known = {id(port) for port in self._ports.values()}
                for key, _ in events:
                    if id(key.data) in known:
                        key.data.ready(key.fd, self._selector)
                for port_name, port in self._ports.items():
                    if port.fd >= 0:
                        self._send(self._cables[port_name], port.fd)

    def _pause(self) -> float:
        """Until the next answer arrives."""
        with self._lock:
            left = (cable.next_arrival() - cable.clock.now() for cable in self._cables.values())
            return min(max(0.0, min(left, default=IDLE_S)), IDLE_S)

    def _send(self, cable: Cable, fd: int) -> None:
        data = cable.deliver(4096, 0.0)
        if data:
            try:
                os.write(fd, data)
            except (BlockingIOError, ConnectionError) as error:  # nobody reads: lost, as on a real cable
                log.debug("%d bytes lost: %s", len(data), error)
