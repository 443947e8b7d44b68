"""``clod-adapt doctor``: on this machine, without torch, and with a wrong image."""

import json
import subprocess
import sys
import webbrowser
from typing import Any

import pytest
import torch

from clod_adapter import rasterizers
from clod_adapter.rasterizers import reference

NAMES = ["torch", "cpu", "gsplat", "browser"]


def test_lines_of_this_machine(clod: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for browser, ok in ((webbrowser.GenericBrowser("lynx"), "off "), (webbrowser.BackgroundBrowser("firefox"), "ok ")):
        monkeypatch.setattr(webbrowser, "get", lambda browser=browser: browser)
        done = clod("doctor")
        *lines, last = done.out.replace("\n    -> ", "  -> ").splitlines()
        assert done.code == 0 and [line.split()[0] for line in lines] == NAMES and lines[3][9:].startswith(ok), done
        assert all((line[9:12] == "ok ") != (" -> " in line) for line in lines)  # what fails has its fix
    assert lines[1].startswith("cpu      ok   renders the reference image (RMS ")
    assert last.startswith("rendering and training backends: cpu")


def test_json_without_torch() -> None:
    """Run as a module, as by torchrun."""
    code = "import sys, runpy; sys.modules['torch'] = None; sys.argv = ['clod-adapt', 'doctor', '--json']\n"
    code += "runpy.run_module('clod_adapter', run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    report = json.loads(done.stdout)
    assert set(report) == {"command", "version", "draws", "exit_code", "findings"} and report["draws"] == []
    assert done.returncode == report["exit_code"] == 1 and "Traceback" not in done.stderr, done.stderr
    found = {each["name"]: each for each in report["findings"]}
    assert [*found] == NAMES and found["torch"]["fix"].startswith("pip install") and not found["cpu"]["ok"]
    assert done.stderr.splitlines()[-1] == "no rendering backend works: fix torch first, then the CPU backend"


@pytest.mark.parametrize("change", ["roll", "nan"])
def test_a_wrong_image_is_reported(clod: Any, monkeypatch: pytest.MonkeyPatch, change: str) -> None:
    def rasterize(**given: Any) -> tuple[torch.Tensor, torch.Tensor]:
        image, alpha = reference.rasterize(**given)
        return {"roll": image.roll(1, 1), "nan": image * torch.nan}[change], alpha

    monkeypatch.setitem(rasterizers.BACKENDS, "cpu", lambda: rasterizers.Rasterizer(rasterize))
    done = clod("doctor", "--json", "--quiet")
    found = {found["name"]: found for found in json.loads(done.out)["findings"]}
    assert done.code == 1 and not found["cpu"]["ok"] and found["torch"]["ok"]
    assert found["cpu"]["found"].startswith("renders another image than the reference")
