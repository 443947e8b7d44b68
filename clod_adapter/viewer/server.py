"""Serves the page over HTTP on the loopback address, from a fixed set of responses.

Requests select one of the responses; no folder is served, no file is opened, nothing is changed. A
request is answered only if its Host header names this machine, which protects against DNS rebinding
by other pages.
"""

import re
import socket
import socketserver
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from clod_adapter.errors import ClodError

HOST = "127.0.0.1"
LOOPBACK = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?", re.ASCII)
IDLE_TIMEOUT = 30  # of a connection between responses, seconds
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
}


@dataclass(frozen=True)
class Response:
    """The response to a path; ``blocks`` returns its bytes in pieces, ``policy`` is the
    Content-Security-Policy.
    """

    media_type: str
    size: int
    blocks: Callable[[], Iterable[bytes]]
    policy: str = "default-src 'none'"


class Server(ThreadingHTTPServer):
    """Serves ``responses``, by path, on loopback once ``serve_forever`` runs; port 0 selects a free
    one.
    """

    # Not daemons: a thread that holds a tensor when the interpreter exits would abort the process.
    daemon_threads = False
    allow_reuse_address = sys.platform != "win32"  # on Windows two servers would share a port

    def __init__(self, responses: Mapping[str, Response], port: int = 0) -> None:
        self.responses = dict(responses)
        self._sockets: set[socket.socket] = set()
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise ClodError(
                f"port {port} of {HOST} is not available ({error.strerror}); choose another, or 0"
                " for a free one"
            ) from error

    @property
    def port(self) -> int:
        return int(self.server_address[1])

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.port}/"

    def server_bind(self) -> None:
        socketserver.TCPServer.server_bind(self)  # HTTPServer's looks up the host name
        self.server_name, self.server_port = HOST, self.port

    def get_request(self) -> tuple[socket.socket, Any]:
        request, address = super().get_request()
        self._sockets.add(request)
        return request, address

    def shutdown_request(self, request: Any) -> None:
        self._sockets.discard(request)
        super().shutdown_request(request)

    def server_close(self) -> None:
        """Closes open connections and waits for their threads."""
        for request in list(self._sockets):
            with suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)
        # of a thread that a Ctrl-C kept from starting; Python waits for the others
        with suppress(RuntimeError):
            super().server_close()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignores connections closed by the browser, for example with its tab."""
        if not isinstance(sys.exc_info()[1], ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "clod-adapt", ""
    timeout = IDLE_TIMEOUT
    server: Server

    def do_GET(self) -> None:
        hosts = self.headers.get_all("Host") or []
        # an ssh tunnel may have another port
        if len(hosts) != 1 or not LOOPBACK.fullmatch(hosts[0].lower()):
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            return
        response = self.server.responses.get(self.path.partition("?")[0])
        if response is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", response.media_type)
        self.send_header("Content-Length", str(response.size))
        self.send_header("Content-Security-Policy", f"{response.policy}; frame-ancestors 'none'")
        self.end_headers()
        # a page that is busy with a file's first rows takes no bytes
        self.connection.settimeout(None)
        for block in response.blocks() if self.command == "GET" else ():
            self.wfile.write(block)
        self.connection.settimeout(self.timeout)

    do_HEAD = do_GET

    def end_headers(self) -> None:
        """Adds the headers of every response, including errors."""
        for name, value in HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged."""
