"""``clod-adapt view`` without a browser: messages, served files, interrupts."""

from __future__ import annotations

import json
import re
import signal
import socket
import time
import urllib.request
import webbrowser
from pathlib import Path
from typing import Any

import pytest

import clod_adapter
from clod_adapter.cli import view
from clod_adapter.cli.main import build_parser, main


def fetch(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=10) as response:
        return bytes(response.read())


def test_serves_until_it_is_interrupted(spawn: Any, capture: Any, dialled: Path, tmp_path: Path) -> None:
    words = [dialled, "--base", capture.ply, "--images", capture.scene, "--sv", 2, "--no-browser", "--json"]
    process = spawn("view", *words, cwd=tmp_path)
    report = json.loads(process.stdout.readline())
    assert report["url"] == f"http://127.0.0.1:{report['port']}/" and report["cameras"] == 10
    (config,) = re.findall(r'id="clod-config">(.*?)</script>', fetch(report["url"]).decode(), re.DOTALL)
    config = json.loads(config)
    assert config["title"] == "dial.ply" and config["virtual_scale"] == 2 and len(config["cameras"]) == 10
    assert (config["model"]["href"], config["base"]["href"]) == ("/files/model", "/files/base")
    for entry, file in (config["model"], dialled), (config["base"], capture.ply):
        (tmp_path / "served.ply").write_bytes(fetch(report["url"] + entry["href"][1:]))
        served, shown = (clod_adapter.load(path).gaussians for path in (tmp_path / "served.ply", file))
        assert len(served) == len(shown) and (served.attenuation is None) == (shown.attenuation is None)
    process.send_signal(signal.SIGTERM)
    out, err = process.communicate(timeout=20)
    assert (process.returncode, out) == (0, "") and "Traceback" not in err and "GET" not in err, err


def test_dial_values_beyond_the_page_are_noted(capture: Any, dialled: Path, capsys: Any) -> None:
    for path, opens, said in (
        (dialled, 4, "the page's dial ends at s = 4"), (capture.ply, 1, "s = 9 has no effect"),
    ):  # fmt: skip
        answers, report = view.make_page(build_parser("view").parse_args([str(path), "--sv=9"]), view.Console(False))
        (config,) = re.findall(r'id="clod-config">(.*?)</script>', b"".join(answers["/"].blocks()).decode(), re.DOTALL)
        assert json.loads(config)["virtual_scale"] == opens and any(said in note for note in report["notes"])
        assert said in capsys.readouterr().err


@pytest.mark.parametrize("name", ["print", "open_browser"])
def test_interrupt_right_after_the_address(capture: Any, monkeypatch: Any, capsys: Any, name: str) -> None:
    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(view, name, interrupted, raising=False)
    assert main(["view", str(capture.ply), "--quiet"]) == 0
    out, err = capsys.readouterr()
    assert err == "" and (name == "print" or re.fullmatch(r"http://127\.0\.0\.1:\d+/  \(Ctrl-C ends\)\n", out))


def test_port_in_use(clod: Any, capture: Any) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        done = clod("view", capture.ply, "--no-browser", "--port", taken.getsockname()[1])
    assert (done.code, done.out) == (2, ""), done
    assert re.search(r"(?m)^clod-adapt: error: .*port \d+ of 127.0.0.1 is not available .*choose another", done.err)


class Browser(webbrowser.BaseBrowser):
    def __init__(self) -> None:
        super().__init__("a browser")
        self.opened: list[str] = []

    def open(self, url: str, new: int = 0, autoraise: bool = True) -> bool:
        self.opened.append(url)
        return True


def test_graphical_browsers_are_opened_and_text_browsers_not(monkeypatch: pytest.MonkeyPatch) -> None:
    browser = Browser()
    monkeypatch.setattr(webbrowser, "get", lambda: browser)
    assert view.open_browser("http://127.0.0.1:1/") and browser.opened == ["http://127.0.0.1:1/"]
    monkeypatch.delenv("BROWSER", raising=False)
    monkeypatch.setattr(webbrowser, "get", lambda: webbrowser.GenericBrowser("true"))
    assert not view.open_browser("http://127.0.0.1:1/")

    def none() -> None:
        raise webbrowser.Error("could not locate runnable browser")

    monkeypatch.setattr(webbrowser, "get", none)
    assert not view.open_browser("http://127.0.0.1:1/")


def test_program_in_browser_variable_is_opened(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Editors set BROWSER. The command does not wait for the program."""
    helper = tmp_path / "helper.sh"
    helper.write_text(f"#!/bin/sh\ncd '{tmp_path}'; echo \"$1\" > part; mv part url; sleep 3\n")
    helper.chmod(0o755)
    monkeypatch.setenv("BROWSER", str(helper))
    monkeypatch.setattr(webbrowser, "get", lambda: webbrowser.GenericBrowser(str(helper)))
    began = time.monotonic()
    assert view.open_browser("http://127.0.0.1:1/") and time.monotonic() - began < 30
    while not (tmp_path / "url").exists():
        time.sleep(0.02)
    assert (tmp_path / "url").read_text() == "http://127.0.0.1:1/\n"
    monkeypatch.setenv("BROWSER", "lynx")
    monkeypatch.setattr(webbrowser, "get", lambda: webbrowser.GenericBrowser("lynx"))
    assert not view.open_browser("http://127.0.0.1:1/")


def test_a_folder_and_several_files(capture: Any, dialled: Path, tmp_path: Path) -> None:
    """A folder's splats by name, numbers by value, without what is none; files with the same name by their folder."""
    for name in ("lod10.ply", "lod2.ply"):
        (tmp_path / name).write_bytes(dialled.read_bytes())
    (tmp_path / "points.ply").write_text("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n")
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "lod2.ply").write_bytes(capture.ply.read_bytes())
    words = ["view", str(tmp_path), str(tmp_path / "more" / "lod2.ply")]
    args = build_parser("view").parse_args(words[1:])
    view.COMMAND.check(args)
    answers, report = view.make_page(args, view.Console(True))
    (config,) = re.findall(r'id="clod-config">(.*?)</script>', b"".join(answers["/"].blocks()).decode(), re.DOTALL)
    config = json.loads(config)
    entries = [config["model"], *config["others"]]
    folder = tmp_path.name
    assert [entry["name"] for entry in entries] == [f"{folder}/lod2.ply", f"{folder}/lod10.ply", "more/lod2.ply"]
    for entry, file in zip(entries, (dialled, dialled, capture.ply), strict=True):
        (tmp_path / "served.ply").write_bytes(b"".join(answers[entry["href"]].blocks()))
        served, shown = (clod_adapter.load(path).gaussians for path in (tmp_path / "served.ply", file))
        assert len(served) == len(shown) and (served.attenuation is None) == (shown.attenuation is None)
    assert report["model"].endswith("lod2.ply") and len(report["files"]) == 3
