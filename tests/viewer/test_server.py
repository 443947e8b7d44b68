"""Responses of the server, and requests that it refuses."""

import http.client
import socket
import threading
import time
from contextlib import contextmanager

import pytest
from refusals import refused

from clod_adapter.errors import ClodError
from clod_adapter.viewer import server as served
from clod_adapter.viewer.server import Response, Server

BLOCKS = (b"a" * 1000, b"b" * 24)
RESPONSES = {
    "/": Response(
        "text/html; charset=utf-8",
        5,
        lambda: (b"hello",),
        "default-src 'none'; script-src 'sha256-x'",
    ),
    "/files/model": Response("application/octet-stream", 1024, lambda: BLOCKS),
}


@contextmanager
def running(responses):
    with Server(responses) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server
        server.shutdown()
    thread.join()


@contextmanager
def asking(server):
    with socket.create_connection(("127.0.0.1", server.port)) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        yield connection


@pytest.fixture(scope="module")
def server():
    with running(RESPONSES) as server:
        yield server


def request(server, path, method="GET", body=None, **headers):
    connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=10)
    try:
        connection.request(method, path, body, headers)
        response = connection.getresponse()
        return response.status, {k.lower(): v for k, v in response.getheaders()}, response.read()
    finally:
        connection.close()


SAFE = {
    "cache-control": "no-store",
    "x-content-type-options": "nosniff",
    "cross-origin-resource-policy": "same-origin",
}
REQUESTS = (  # method, path, Host, status
    *(("GET", path, None, 200) for path in ("/?any=thing", "/files/model")),
    ("HEAD", "/files/model", None, 200),
    *(
        ("GET", path, None, 404)
        for path in ("/files/", "/files/base", "/files/../", "/etc/passwd", "/%2e%2e/", "*")
    ),
    *((method, "/", None, 501) for method in ("POST", "PUT", "DELETE", "OPTIONS", "CONNECT")),
    *(
        ("GET", "/files/model", host, 421)
        for host in ("evil.example:80", "127.0.0.1.evil.example", "0.0.0.0", "")
    ),
    ("GET", "/", "localhost:9@evil.example", 421),
    *(("GET", "/", host, 200) for host in ("localhost", "LOCALHOST:8000", "127.0.0.1:1")),
)


def test_responses(server):
    assert server.socket.getsockname()[0] == "127.0.0.1"
    assert server.url == f"http://127.0.0.1:{server.port}/"
    for method, path, host, wanted in REQUESTS:
        given = {} if host is None else {"Host": host}
        status, headers, body = request(server, path, method, **given)
        assert status == wanted and headers.items() >= SAFE.items(), (method, path, host, status)
        assert "access-control-allow-origin" not in headers
        assert "python" not in headers["server"].lower()
        if method == "GET" and status == 200:
            page = path.startswith("/files")
            assert body == (b"".join(BLOCKS) if page else b"hello")
            scripts = "" if page else "; script-src 'sha256-x'"
            policy = f"default-src 'none'{scripts}; frame-ancestors 'none'"
            assert headers["content-security-policy"] == policy
        else:
            assert BLOCKS[0] not in body
    with refused(f"^port {server.port} of 127.0.0.1 .*choose another"):
        Server({}, server.port)


def test_only_the_page_sends_files(monkeypatch):
    """A file is converted if it is from the page, has a length and is not too long; what is cut is
    not. The file is then gone.
    """
    given = []

    def convert(path):
        given.append((path, path.read_bytes()))
        if path.suffix == ".bad":
            raise ClodError(f"{path}: is\nbad")
        return RESPONSES["/files/model"]

    monkeypatch.setattr(served, "MOST_BYTES", 9)
    with running({"/": RESPONSES["/"], "/convert": convert}) as server:
        page = {"Origin": f"http://127.0.0.1:{server.port}"}
        for path, headers, wanted in (
            ("/convert", {}, 403),
            ("/convert", {"Origin": "null"}, 403),
            ("/convert", {"Origin": "https://evil.example"}, 403),
            ("/convert", {"Origin": f"http://localhost:{server.port}"}, 403),
            ("/convert", {"Origin": "http://evil.example", "Host": "evil.example"}, 421),
            ("/", page, 501),
            ("/none", page, 501),
            ("/convert", page | {"Content-Length": "10"}, 413),
            ("/convert", page | {"Content-Length": "-1"}, 411),
            ("/convert", page | {"Transfer-Encoding": "chunked"}, 411),
        ):
            assert request(server, path, "POST", **headers)[0] == wanted, (path, headers)
        assert request(server, "/convert")[0] == 404
        with socket.create_connection(("127.0.0.1", server.port)) as connection:
            head = "POST /convert HTTP/1.1\r\nHost: localhost\r\nOrigin: http://localhost\r\n"
            connection.sendall(f"{head}Content-Length: 9\r\n\r\nshort".encode())
            connection.shutdown(socket.SHUT_WR)
            assert connection.recv(100) == b""
        assert given == []
        query = "/convert?name=..%2F%C3%B6%2F..%2Fa.splat"
        status, _, body = request(server, query, "POST", b"123456789", **page)
        assert status == 200 and body == b"".join(BLOCKS)
        status, headers, body = request(server, "/convert?name=%C3%B6.bad", "POST", b"1", **page)
        assert status == 422 and body.decode() == "ö.bad: is bad"
        assert headers["content-type"].startswith("text/plain")
    named = [(path.name, data) for path, data in given]
    assert named == [("___.._a.splat", b"123456789"), ("_.bad", b"1")]
    assert all(path.parent.name.startswith("clod-adapt-") for path, _ in given)
    assert not any(path.exists() or path.parent.exists() for path, _ in given)


def test_a_busy_page_gets_the_rest_later(monkeypatch):
    """It takes no bytes for longer than an idle connection is kept."""
    monkeypatch.setattr(served._Handler, "timeout", 0.1)
    size = 1 << 25
    with (
        running({"/": Response("text/html", size, lambda: (bytes(size),))}) as server,
        asking(server) as connection,
    ):
        time.sleep(0.4)
        found = 0
        while found < size and (data := connection.recv(1 << 20)):
            found += len(data)
        assert found >= size


def test_disconnected_and_closed(capfd):
    """Closing waits for running responses: a thread that holds a tensor as the interpreter exits
    aborts the process.
    """
    ended = []

    def endless():
        try:
            while True:
                yield bytes(1 << 20)
        finally:
            ended.append(1)

    response = Response("application/octet-stream", 1 << 40, endless)
    with running({"/": response, "/other": RESPONSES["/"]}) as server:
        with asking(server) as connection:
            assert connection.recv(100)
        deadline = time.monotonic() + 10
        while not ended and time.monotonic() < deadline:
            time.sleep(0.01)
        assert ended == [1] and request(server, "/other")[0] == 200
        with (
            asking(server) as slow,
            socket.create_connection(("127.0.0.1", server.port)),
        ):  # the second requests nothing
            assert slow.recv(100)
            server.shutdown()
            server.server_close()
            assert ended == [1, 1]
    assert capfd.readouterr() == ("", "")
