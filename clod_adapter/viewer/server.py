"""Serves the page over HTTP on the loopback address, from a fixed set of responses.

A GET selects one of the responses; no folder is served, no file is opened. A POST of the page has a
file that the page cannot read: it lies in a temporary folder while it is converted to what the page
shows. A request is answered only if its Host header names this machine, which protects against DNS
rebinding by other pages, and a POST only if its Origin header names this server too.
"""

import re
import socket
import socketserver
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import parse_qs

from clod_adapter.errors import ClodError

HOST = "127.0.0.1"
LOOPBACK = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?", re.ASCII)
IDLE_TIMEOUT = 30  # of a connection between responses, seconds
MOST_BYTES = 2 << 30  # of a file that the page sends
BLOCK_BYTES = 1 << 20  # read at once
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


Converter = Callable[[Path], Response]
"""Makes what the page shows of a file; raises a ClodError of one line, which the page shows."""


class Server(ThreadingHTTPServer):
    """Serves ``responses``, by path, on loopback once ``serve_forever`` runs; port 0 selects a free
    one. A path with a converter takes files, one at a time.
    """

    # Not daemons: a thread that holds a tensor when the interpreter exits would abort the process.
    daemon_threads = False
    allow_reuse_address = sys.platform != "win32"  # on Windows two servers would share a port

    def __init__(self, responses: Mapping[str, Response | Converter], port: int = 0) -> None:
        self.responses = dict(responses)
        self.converting = threading.Lock()
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
    server_version = "clod-adapt"
    sys_version = ""
    timeout = IDLE_TIMEOUT
    server: Server

    def do_GET(self) -> None:
        if not self._names_this_machine():
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            return
        response = self.server.responses.get(self.path.partition("?")[0])
        if not isinstance(response, Response):
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self._send(response)

    do_HEAD = do_GET

    def do_POST(self) -> None:
        """Answers a file with what a converter makes of it, or with the reason why it cannot."""
        path, _, query = self.path.partition("?")
        convert = self.server.responses.get(path)
        length = self.headers.get("Content-Length") or ""
        refusal = None
        if not self._names_this_machine():
            refusal = HTTPStatus.MISDIRECTED_REQUEST
        elif convert is None or isinstance(convert, Response):
            refusal = HTTPStatus.NOT_IMPLEMENTED
        elif self.headers.get_all("Origin") != [f"http://{self.headers['Host']}"]:
            refusal = HTTPStatus.FORBIDDEN
        elif not re.fullmatch(r"\d{1,15}", length, re.ASCII):
            refusal = HTTPStatus.LENGTH_REQUIRED
        elif int(length) > MOST_BYTES:
            refusal = HTTPStatus.REQUEST_ENTITY_TOO_LARGE
        else:
            self._convert(convert, int(length), parse_qs(query).get("name", ["the file"])[0])
        if refusal is not None:
            self.send_error(refusal)

    def _names_this_machine(self) -> bool:
        hosts = self.headers.get_all("Host") or []
        # an ssh tunnel may have another port
        return len(hosts) == 1 and LOOPBACK.fullmatch(hosts[0].lower()) is not None

    def _convert(self, convert: Converter, length: int, name: str) -> None:
        """Answers with the conversion of the request's body, a file of this name."""
        # readers go by the suffix and, for one rank of a checkpoint, by the name
        plain = re.sub(r"[^\w.-]", "_", name, flags=re.ASCII)[-100:].lstrip(".") or "file"
        with TemporaryDirectory(prefix="clod-adapt-") as folder:
            file = Path(folder) / plain
            try:
                if not self._receive(file, length):
                    self.close_connection = True
                    return
                with self.server.converting:
                    response = convert(file)
            except (ClodError, MemoryError) as error:
                reason = str(error) or "too little memory to read it"
                line = str(ClodError(reason.replace(str(file), name))).encode()
                status = HTTPStatus.UNPROCESSABLE_ENTITY
                self._send(
                    Response("text/plain; charset=utf-8", len(line), lambda: (line,)), status
                )
                return
        self._send(response)

    def _receive(self, file: Path, length: int) -> bool:
        """Writes the request's body to a file; whether all of it came."""
        try:
            with open(file, "wb") as out:
                while length and (block := self.rfile.read(min(length, BLOCK_BYTES))):
                    length -= out.write(block)
        except (ConnectionError, TimeoutError):
            raise
        except OSError as error:  # such as a full disk
            self.close_connection = True
            raise ClodError(f"{file}: cannot be stored for reading ({error.strerror})") from error
        return length == 0

    def _send(self, response: Response, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        self.send_header("Content-Type", response.media_type)
        self.send_header("Content-Length", str(response.size))
        self.send_header("Content-Security-Policy", f"{response.policy}; frame-ancestors 'none'")
        self.end_headers()
        # a page that is busy with a file's first rows takes no bytes
        self.connection.settimeout(None)
        for block in response.blocks() if self.command != "HEAD" else ():
            self.wfile.write(block)
        self.connection.settimeout(self.timeout)

    def end_headers(self) -> None:
        """Adds the headers of every response, including errors."""
        for name, value in HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not logged."""
