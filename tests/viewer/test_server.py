"""The server's answers and refusals."""

from __future__ import annotations

import http.client
import socket
import threading
from collections.abc import Iterator

import pytest

from clod_adapter.errors import ClodError
from clod_adapter.viewer.server import Answer, Server, is_here

BLOCKS = (b"a" * 1000, b"b" * 24)


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    answers = {
        "/": Answer("text/html; charset=utf-8", 5, lambda: (b"hello",), "default-src 'none'; script-src 'sha256-x'"),
        "/files/model": Answer("application/octet-stream", 1024, lambda: BLOCKS),
    }
    with Server(answers) as server:
        threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
        yield server
        server.shutdown()


def ask(server: Server, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    try:
        connection.request(method, path, headers=headers)
        response = connection.getresponse()
        return response.status, {k.lower(): v for k, v in response.getheaders()}, response.read()
    finally:
        connection.close()


def test_answers(server: Server) -> None:
    assert server.socket.getsockname()[0] == "127.0.0.1" and server.url == f"http://127.0.0.1:{server.port}/"
    status, headers, body = ask(server, "/?any=thing")
    assert (status, body) == (200, b"hello")
    assert headers["content-security-policy"] == "default-src 'none'; script-src 'sha256-x'; frame-ancestors 'none'"
    status, headers, body = ask(server, "/files/model")
    assert (status, body, headers["content-type"]) == (200, b"".join(BLOCKS), "application/octet-stream")
    assert ask(server, "/files/model", "HEAD")[::2] == (200, b"")
    for path in ("/", "/files/model", "/nothing"):
        _, headers, _ = ask(server, path)
        assert headers["cache-control"] == "no-store" and headers["x-content-type-options"] == "nosniff"
        assert headers["cross-origin-resource-policy"] == "same-origin" and "access-control-allow-origin" not in headers
        assert "python" not in headers["server"].lower()


def test_other_requests_are_refused(server: Server) -> None:
    for path in ("/files", "/files/", "/files/base", "/files/../", "/etc/passwd", "/%2e%2e/", "/index.html", "*"):
        assert ask(server, path)[0] == 404, path
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "CONNECT"):
        assert ask(server, "/", method)[0] == 501, method
    with pytest.raises(ClodError, match=f"^port {server.port} of 127.0.0.1 .*give another"):
        Server({}, server.port)


def test_other_host_names_are_refused(server: Server) -> None:
    others = ("evil.example", "evil.example:80", "127.0.0.1.evil.example", "0.0.0.0", "", "localhost:9@evil.example")
    for host in others:
        status, _, body = ask(server, "/files/model", Host=host)
        assert status == 421 and BLOCKS[0] not in body, host
    for host in ("localhost", "LOCALHOST:8000", "127.0.0.1:1"):
        assert ask(server, "/", Host=host)[0] == 200, host
    assert not is_here([]) and not is_here(["localhost", "localhost"])


def test_a_browser_that_disconnects(server: Server, capfd: pytest.CaptureFixture[str]) -> None:
    gone = threading.Event()

    def blocks() -> Iterator[bytes]:
        yield b"x" * (1 << 20)
        gone.wait(10)
        while True:
            yield b"x" * (1 << 20)

    server.answers["/long"] = Answer("text/plain", 1 << 40, blocks)
    before = threading.active_count()
    with socket.create_connection(("127.0.0.1", server.port)) as connection:
        connection.sendall(b"GET /long HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert connection.recv(1000)
    gone.set()
    for thread in threading.enumerate():
        if "process_request_thread" in thread.name:
            thread.join(10)
    assert threading.active_count() <= before and ask(server, "/")[0] == 200
    assert capfd.readouterr() == ("", "")


def test_closing_disconnects_and_waits_for_running_answers() -> None:
    """A thread that still held a tensor at the end would abort the process."""
    held: list[int] = []

    def blocks() -> Iterator[bytes]:
        try:
            while True:
                yield bytes(1 << 20)
        finally:
            held.append(1)

    with Server({"/": Answer("application/octet-stream", 1 << 40, blocks)}) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        with (
            socket.create_connection(("127.0.0.1", server.port)) as slow,
            socket.create_connection(("127.0.0.1", server.port)),
        ):  # the second one asks for nothing
            slow.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
            assert slow.recv(100)
            server.shutdown()
            server.server_close()
            assert held == [1]
    thread.join()


def test_an_interrupt_while_a_thread_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ctrl-C at the moment of a request."""

    def interrupted(self: threading.Thread) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(threading.Thread, "start", interrupted)
    with pytest.raises(KeyboardInterrupt), Server({}) as server, socket.create_connection(("127.0.0.1", server.port)):
        server.handle_request()
