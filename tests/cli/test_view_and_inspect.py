"""``clod-adapt view`` without a page in a browser: messages, files, interrupts; texts of
``clod-adapt inspect``.
"""

import json
import os
import re
import shutil
import signal
import socket
import urllib.request
import webbrowser
from pathlib import Path
from unittest.mock import Mock

import clod_adapter
from clod_adapter.cli import view
from clod_adapter.cli.main import build_parser
from runs import data_in, log_of, wait_for


def fetch(url):
    with urllib.request.urlopen(url, timeout=10) as response:
        return bytes(response.read())


def config_of(page):
    """The settings that a page holds."""
    return json.loads(data_in(page.decode(), "clod-config")[0])


def assert_holds(data, file, folder):
    (folder / "served.ply").write_bytes(data)
    served, shown = (clod_adapter.load(path).gaussians for path in (folder / "served.ply", file))
    assert len(served) == len(shown) and (served.attenuation is None) == (shown.attenuation is None)


def test_serves_until_it_is_interrupted(server, capture, attenuated, tmp_path):
    words = ["view", attenuated, "--base", capture.ply, "--images", capture.scene, "--sv", 2]
    process = server.start(tmp_path, *words, "--no-browser", "--json", "--quiet")
    wait_for(Path(f"{tmp_path}.log"), "\n")
    report = json.loads(log_of(tmp_path))
    assert report["url"] == f"http://127.0.0.1:{report['port']}/" and report["cameras"] == 10
    config = config_of(fetch(report["url"]))
    assert config["title"] == "dial.ply"
    assert config["virtual_scale"] == 2
    assert len(config["cameras"]) == 10
    for name, file in ("model", attenuated), ("base", capture.ply):
        assert config[name]["href"] == f"/files/{name}"
        assert_holds(fetch(f"{report['url']}files/{name}"), file, tmp_path)
    os.kill(process, signal.SIGTERM)
    assert server.wait(process) == 0 and log_of(tmp_path).count("\n") == 1


def test_dial_values_and_files_of_a_page(capture, attenuated, tmp_path, capsys):
    """Of a folder the splats by name, numbers by value; files of one name have those of their
    folders. With notes.
    """

    def page_of(*words):
        args = build_parser("view").parse_args([*map(str, words)])
        view.check(args)
        answers, report = view.make_page(args, view.Console(False))
        return answers, report, config_of(b"".join(answers["/"].blocks()))

    for path, opens, said in (
        (attenuated, 4, "the page's dial ends at s = 4"),
        (capture.ply, 1, "s = 9 has no effect"),
    ):
        _, report, config = page_of(path, "--sv=9")
        (note,) = [note for note in report["notes"] if said in note]
        assert config["virtual_scale"] == opens and note in capsys.readouterr().err
    (tmp_path / "more").mkdir()
    files = {"lod2.ply": attenuated, "lod10.ply": attenuated, "more/lod2.ply": capture.ply}
    for name, file in files.items():
        shutil.copy(file, tmp_path / name)
    (tmp_path / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nend_header\n"
    )
    answers, report, config = page_of(tmp_path, tmp_path / "more" / "lod2.ply")
    entries = [config["model"], *config["others"]]
    folder = tmp_path.name
    names = f"{folder}/lod2.ply {folder}/lod10.ply more/lod2.ply"
    assert [entry["name"] for entry in entries] == names.split()
    for entry, file in zip(entries, files.values(), strict=True):
        assert_holds(b"".join(answers[entry["href"]].blocks()), file, tmp_path)
    assert report["model"].endswith("lod2.ply") and len(report["files"]) == 3


def test_interrupts_and_browsers(clod, monkeypatch):
    """One that opens a window is opened; an interrupt right after the address ends the command as
    usual.
    """
    browser = Mock(spec=webbrowser.BaseBrowser, **{"open.side_effect": KeyboardInterrupt})
    monkeypatch.setattr(webbrowser, "get", lambda: browser)
    assert clod("view BASE --quiet") == (f"{browser.open.call_args[0][0]}  (Ctrl-C ends)\n", "")
    monkeypatch.setenv("BROWSER", "editor")  # a program whose end is not waited for
    monkeypatch.setattr(webbrowser, "get", lambda: webbrowser.GenericBrowser("editor"))
    assert isinstance(view.find_browser(), webbrowser.BackgroundBrowser)
    error = webbrowser.Error("could not locate runnable browser")
    monkeypatch.setattr(webbrowser, "get", Mock(side_effect=error))
    assert view.find_browser() is None
    with socket.create_server(("127.0.0.1", 0)) as taken:
        done = clod("view BASE --no-browser --port", taken.getsockname()[1], code=2)
    said = r"^clod-adapt: error: .*port \d+ of 127.0.0.1 is not available .*choose another"
    assert re.search(said, done.err, re.M)


def test_a_plain_file_fits_on_a_screen(clod, capture):
    done = clod("inspect BASE")
    lines = done.out.splitlines()
    assert len(lines) <= 24 and max(map(len, lines[1:])) <= 120 and done.err == ""
    assert lines[0].startswith(f"{capture.ply} (")
    assert lines[2] == "Gaussians    300" and "dial         none: no sigma_d" in lines
    titles = ["least", "1", "%", "median", "99", "%", "greatest"]
    at = next(k for k, line in enumerate(lines) if line.split() == titles)
    table = lines[at : at + 6]
    assert [line.split()[0] for line in table[1:]] == ["x", "y", "z", "scale", "opacity"]
    assert len({len(line) for line in table}) == 1


def test_a_dial_and_its_quality_table(clod, attenuated):
    text = clod("inspect DIAL").out
    report = clod("inspect DIAL --json").report
    lines = text.splitlines()
    splat = report["splat"]
    assert "written by   clod-adapter" in text and len(lines) <= 32
    assert "s = 1 to 4, distances in world units" in text
    at = next(k for k, line in enumerate(lines) if "Gaussians" in line and "PSNR" in line)
    table = [line.split() for line in lines[at + 1 : at + 8]]
    assert table[0][0] == "1" and table[-1][0] == "4" and {len(row) for row in table} == {5}
    assert report["command"] == "inspect" and report["path"] == str(attenuated)
    assert report["oddities"] == [] and "anomalies" not in report
    assert splat["count"] == splat["total"] == 540
    told = json.loads(attenuated.with_suffix(".json").read_text())
    assert splat["dial"]["calibration"] == told["calibration"]
    clod("export DIAL --sv 2 -o x.ply")
    comment = "\nsays         baked at s = 2 by clod-adapter for 8 training cameras\n"
    assert comment in clod("inspect x.ply").out
