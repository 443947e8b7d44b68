"""The page over HTTP on this machine alone: a fixed set of answers at the loopback address.

What is asked for is looked up among the answers, and nothing else is there: no folder is served, no file is opened, no
request changes anything. A request is answered only where its Host header is a name of this machine, so that a page
from elsewhere whose name was made to point here (DNS rebinding) reads nothing.
"""

from __future__ import annotations

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
from typing import Any

from clod_adapter.errors import ClodError

HOST = "127.0.0.1"
THIS_MACHINE = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?", re.ASCII)
SECONDS = 30  # without a word from the other side, then it is given up


@dataclass(frozen=True)
class Answer:
    """What a path is answered with.

    Attributes:
        kind: its media type.
        size: bytes.
        blocks: makes the bytes, for each request anew.
        policy: the Content-Security-Policy of a page.
    """

    kind: str
    size: int
    blocks: Callable[[], Iterable[bytes]]
    policy: str = "default-src 'none'"


class Server(ThreadingHTTPServer):
    """Serves ``answers``, by path, on loopback, from ``serve_forever`` on; a context manager that closes the port.

    Args:
        answers: by path, with its leading slash; of an address, what follows ``?`` does not matter.
        port: 0 takes a free one.

    Raises:
        ClodError: the port is taken or may not be listened on.
    """

    # Waited for when it is closed: one that still held a tensor while the interpreter ends would abort the process.
    daemon_threads = False
    block_on_close = (
        False  # server_close waits; socketserver's would for threads, too, that a Ctrl-C kept from starting
    )
    allow_reuse_address = sys.platform != "win32"  # there it would let two servers share a port

    def __init__(self, answers: Mapping[str, Answer], port: int = 0) -> None:
        self.answers = dict(answers)
        self._requests: set[socket.socket] = set()
        self._answering: list[threading.Thread] = []
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise ClodError(
                f"port {port} of {HOST} cannot be listened on ({error.strerror or error}); give another, or 0 for a "
                "free one"
            ) from error

    @property
    def port(self) -> int:
        return int(self.server_address[1])

    @property
    def url(self) -> str:
        return f"http://{HOST}:{self.port}/"

    def server_bind(self) -> None:
        socketserver.TCPServer.server_bind(self)  # HTTPServer's asks the name service for this machine's name
        self.server_name, self.server_port = HOST, self.port

    def get_request(self) -> tuple[socket.socket, Any]:
        request, address = super().get_request()
        self._requests.add(request)
        return request, address

    def process_request(self, request: Any, client_address: Any) -> None:
        thread = threading.Thread(target=self.process_request_thread, args=(request, client_address))
        self._answering = [*(each for each in self._answering if each.is_alive()), thread]
        thread.start()

    def shutdown_request(self, request: Any) -> None:
        self._requests.discard(request)
        super().shutdown_request(request)

    def server_close(self) -> None:
        """Hangs up on whoever is still being answered, and waits for the threads that did."""
        for request in list(self._requests):
            with suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)
        super().server_close()
        for thread in self._answering:
            if thread.is_alive():  # and not one that has not started
                thread.join()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Says nothing of a browser that goes away within an answer, as it does when its tab is closed."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version, sys_version = "clod-adapt", ""
    timeout = SECONDS
    server: Server

    def do_GET(self) -> None:
        self._answer(whole=True)

    def do_HEAD(self) -> None:
        self._answer(whole=False)

    def _answer(self, *, whole: bool) -> None:
        if not is_here(self.headers.get_all("Host") or []):
            self.send_error(HTTPStatus.MISDIRECTED_REQUEST)
            return
        answer = self.server.answers.get(self.path.partition("?")[0])
        if answer is None:
            self.send_error(HTTPStatus.NOT_FOUND)
            return
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", answer.kind)
        self.send_header("Content-Length", str(answer.size))
        self.send_header("Content-Security-Policy", f"{answer.policy}; frame-ancestors 'none'")
        self.end_headers()
        for block in answer.blocks() if whole else ():
            self.wfile.write(block)

    def end_headers(self) -> None:
        """With those that every answer has, errors too."""
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Cross-Origin-Opener-Policy", "same-origin")
        self.send_header("Referrer-Policy", "no-referrer")
        super().end_headers()

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: requests are no news."""


def is_here(hosts: list[str]) -> bool:
    """Whether a request's Host headers name this machine, at whichever port (that of an ssh tunnel may be another)."""
    return len(hosts) == 1 and THIS_MACHINE.fullmatch(hosts[0].lower()) is not None
