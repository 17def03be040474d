"""Serve an application over HTTP on a thread of its own, with bounds for slow clients."""

from __future__ import annotations

import socket
from asyncio import TimerHandle, Transport
from collections.abc import Sequence
from functools import partial
from threading import Thread
from typing import Any, cast

import uvicorn
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from gis_radar.base import OutputError

MOST_CONNECTIONS = 300  # a third of the 1,024 files that a process may usually open
_BACKLOG = 64  # connections that are accepted at once, beyond these
REQUEST_S = 5.0  # longest wait for a whole request; browsers also open spare connections
_UNREAD_S = 60.0  # longest wait for a client to read an answer: a megabyte at 20 kB/s
_END_S = 2.0
_LOOPBACK = ("127.0.0.1", "localhost", "::1", "[::1]")


class BoundedConnection(H11Protocol):
    """Connection that is closed if its client sends no request, or does not read the answer.

    uvicorn has no such bounds: its own time-out begins after the first answer and ends with the
    next byte. Of too many connections, the one waiting longest for a request is closed.
    """

    def __init__(self, *given: Any, unread_s: float, **more: Any) -> None:
        super().__init__(*given, **more)
        self._unread_s = unread_s

    request_due: TimerHandle
    _reading_due: TimerHandle | None = None

    @property
    def answering(self) -> bool:
        """Whether a request has come and its answer is not complete."""
        return self.cycle is not None and not self.cycle.response_complete

    def connection_made(self, transport: Transport) -> None:  # type: ignore[override]
        """Start waiting for the first request."""
        super().connection_made(transport)
        self.request_due = self.loop.call_later(REQUEST_S, transport.close)
        if len(self.connections) > MOST_CONNECTIONS:
            all_of_them = cast("set[BoundedConnection]", self.connections)
            idle = (each for each in all_of_them if not each.answering)
            oldest = min(idle, key=lambda each: each.request_due.when())
            self.connections.discard(oldest)
            oldest.transport.abort()

    def data_received(self, data: bytes) -> None:
        """Process a part of a request."""
        super().data_received(data)
        if self.answering:
            self.request_due.cancel()

    def on_response_complete(self) -> None:
        """Wait for the next request, unless it has already come."""
        super().on_response_complete()
        if not self.answering:
            self.request_due = self.loop.call_later(REQUEST_S, self.transport.close)

    def pause_writing(self) -> None:
        """Start waiting for the client to read."""
        super().pause_writing()
        self._reading_due = self.loop.call_later(self._unread_s, self.transport.abort)

    def resume_writing(self) -> None:
        """Stop waiting, as the client has read."""
        super().resume_writing()
        if self._reading_due is not None:
            self._reading_due.cancel()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop all waits."""
        super().connection_lost(exc)
        self.request_due.cancel()
        self.resume_writing()


class WebServer:
    """Server of an application, until it is closed.

    Parameters
    ----------
    app : ASGI application
        The application.
    address : str
        HOST:PORT.
    names : sequence of str
        Host names that requests may have besides this machine's own, so that no other page can
        reach it through a browser; by default any, where other machines reach the address.
    unread_s : float
        Longest wait for a client to read an answer, seconds.

    Raises
    ------
    OutputError
        If the address is taken.
    """

    def __init__(
        self, app: ASGIApp, address: str, names: Sequence[str] = (), *, unread_s: float = _UNREAD_S
    ) -> None:
        self._host, _, port = address.rpartition(":")
        host = self._host.strip("[]")
        hosts = [*names, *_LOOPBACK] if names or host in _LOOPBACK else ["*"]
        config = uvicorn.Config(
            TrustedHostMiddleware(app, allowed_hosts=hosts),
            http=cast("type[H11Protocol]", partial(BoundedConnection, unread_s=unread_s)),
            ws="none",
            log_config=None, log_level="critical", backlog=_BACKLOG, timeout_graceful_shutdown=1,
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            self._socket = socket.create_server((host, int(port)), family=family, backlog=_BACKLOG)
        except OSError as error:
            raise OutputError(
                "{}: cannot be served: {}",
                address,
                error.strerror,
                hint="another program may use the address",
            ) from error
        self._thread = Thread(
            target=self._server.run, args=([self._socket],), daemon=True, name=f"web {port}"
        )

    def open(self) -> str:
        """Start serving, and return the address."""
        self._thread.start()
        return f"http://{self._host}:{self._socket.getsockname()[1]}/"

    def close(self) -> None:
        """Stop serving."""
        self._server.should_exit = True
        if self._thread.is_alive():
            self._thread.join(_END_S)
        self._socket.close()
