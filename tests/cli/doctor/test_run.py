"""``clod-adapt doctor`` on this machine, and on simulated machines with defects."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

import gsplat_in_torch
import inria_forks
from clod_adapter import rasterizers
from clod_adapter.cli.doctor import gpu as doctor_gpu
from clod_adapter.cli.doctor import run, tools
from clod_adapter.cli.doctor.checks import Check, CheckFailed
from clod_adapter.cli.doctor.reference_scene import ReferenceScene
from clod_adapter.errors import ClodError
from clod_adapter.rasterizers import reference

NAMES = [
    "python", "torch", "cpu", "driver", "cuda", "gsplat", "gpu", "inria", "processes", "plots", "glb",
    "splat-transform", "lpips", "flip", "browser", "cores", "memory", "cache",
]  # fmt: skip
TYPES = {"name": "str", "ok": "bool", "found": "str", "fix": "str"}


def find(name: str) -> Check:
    return Check.run(name, run.PROBES[name])


def program(folder: Path, name: str, script: str) -> None:
    (folder / name).write_text(f"#!/bin/sh\n{script}\n")
    (folder / name).chmod(0o755)


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The CPU in place of a GPU."""
    device = torch.device("cpu")
    monkeypatch.setattr(doctor_gpu, "cuda_device", lambda: device)
    return device


def test_all_checks_run_here(clod: Any) -> None:
    done = clod("doctor")
    *lines, last = done.out.replace("\n    -> ", "  -> ").splitlines()
    assert done.code == 0 and [line.split()[0] for line in lines] == NAMES
    for line in lines:
        assert (line[17:20] == "ok ") != (" -> " in line), line  # a failed check has its fix
    assert "cpu              ok   compiled for " in done.out and "RMS" in done.out
    assert last.startswith("rendering and training backends: cpu")


def test_json_without_torch() -> None:
    """Run as a module, as by torchrun: all other checks run, and the exit code is 1."""
    code = "import sys, runpy; sys.modules['torch'] = None; sys.argv = ['clod-adapt', 'doctor', '--json']\n"
    code += "runpy.run_module('clod_adapter', run_name='__main__')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    report = json.loads(done.stdout)
    assert set(report) == {"command", "version", "draws", "exit_code", "findings", "seconds"}
    assert done.returncode == report["exit_code"] == 1 and report["draws"] == [], done.stderr
    assert [finding["name"] for finding in report["findings"]] == list(report["seconds"]) == NAMES
    for finding in report["findings"]:
        assert {name: type(value).__name__ for name, value in finding.items()} == TYPES
        assert finding["found"] and not (finding["ok"] and finding["fix"]), finding
    found = {finding["name"]: finding for finding in report["findings"]}
    assert not found["torch"]["ok"] and found["torch"]["fix"].startswith("pip install") and found["memory"]["ok"]
    assert "Traceback" not in done.stderr and sum(report["seconds"].values()) < 60


def broken(change: Callable[[torch.Tensor], torch.Tensor]) -> Any:
    """A rasterizer that applies ``change`` to the reference's image."""

    def rasterize(**given: Any) -> tuple[torch.Tensor, torch.Tensor]:
        image, alpha = reference.rasterize(**given)
        return change(image), alpha

    return rasterize


wrong = broken(lambda image: image.roll(1, dims=1))


def test_a_wrong_image_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    for rasterize in (wrong, broken(lambda image: image * float("nan")), broken(lambda image: image.transpose(0, 1))):
        monkeypatch.setattr(rasterizers, "for_device", lambda device, rasterize=rasterize: rasterize)
        found = find("cpu")
        assert not found.ok and found.found.startswith("renders another image than the reference") and found.fix


def test_no_working_backend_is_an_error(clod: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rasterizers, "for_device", lambda device: wrong)
    monkeypatch.setattr(run, "PROBES", {name: run.PROBES[name] for name in ("torch", "cpu", "gpu")})
    done = clod("doctor")
    last = "no rendering backend works: fix torch first, then the CPU backend"
    assert done.code == 1 and done.out.splitlines()[-1] == last


def test_any_error_is_a_result() -> None:
    def probe() -> str:
        print("chatter")
        raise MemoryError("no room\nand more")

    assert Check.run("x", probe) == Check("x", False, "failed with MemoryError: no room")
    compiled = SystemError("returned a result with an exception set")  # as Numba hands on a Ctrl-C
    compiled.__cause__ = KeyboardInterrupt()
    for interrupt in (KeyboardInterrupt(), compiled):
        with pytest.raises(type(interrupt)):
            Check.run("x", lambda raised=interrupt: (_ for _ in ()).throw(raised))


@pytest.mark.parametrize(
    ("script", "bus", "ok", "said", "fix"),
    [
        ("echo 'NVIDIA H200, 570.1, 143771 MiB'", True, True, "NVIDIA H200, 570.1, 143771 MiB", ""),
        ("echo 'Driver/library version mismatch'; exit 18", True, False, "failed: Driver/library ver", "--gpus all"),
        ("echo 'could not talk to the driver' >&2; exit 9", True, False, "failed: could not talk", "--gpus all"),
        ("exit 0", True, False, "no GPU listed", "--gpus all"),
        (None, True, False, "no nvidia-smi", "https://www.nvidia.com/drivers"),
        (None, False, False, "no NVIDIA GPU on the PCI bus", "use a machine with an NVIDIA GPU"),
        ("sleep 5", True, False, "does not answer", "restart"),
    ],
)
def test_driver_check(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, script: str | None, bus: bool, ok: bool, said: str, fix: str
) -> None:
    (tmp_path / "bus" / "0000:01").mkdir(parents=True)
    (tmp_path / "bus" / "0000:01" / "vendor").write_text("0x10de\n" if bus else "0x8086\n")
    monkeypatch.setattr(doctor_gpu, "PCI", tmp_path / "bus")
    monkeypatch.setattr(doctor_gpu, "TIMEOUT", 0.5)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}/bin" if script else str(tmp_path))
    if script:
        program(tmp_path, "nvidia-smi", script)
    found = find("driver")
    assert found.ok == ok and said in found.found and fix in found.fix, found


def test_torch_without_cuda(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(torch.version, "cuda", None)
    program(tmp_path, "nvidia-smi", "")
    monkeypatch.setenv("PATH", str(tmp_path))
    for name in ("cuda", "gpu"):
        found = find(name)
        assert not found.ok and found.found == f"torch {torch.__version__} is a CPU build"
        assert found.fix.startswith("pip install") and "--index-url https://download.pytorch.org/whl/cu" in found.fix
    monkeypatch.setenv("PATH", "")
    assert find("cuda").fix.startswith("fix driver first, then pip install")
    monkeypatch.setattr(torch.version, "hip", "6.4")
    assert find("cuda").found.endswith("is built for ROCm 6.4")


@pytest.mark.parametrize(
    ("says", "fix"),
    [
        ("Found no NVIDIA driver on your system.\nPlease check", "fix driver first"),
        ("The NVIDIA driver on your system is too old (found version 11040)", "update NVIDIA's driver, or install a"),
        ("CUDA error: no kernel image is available for execution", "update NVIDIA's driver, or install a"),
    ],
)
def test_a_gpu_that_torch_cannot_use(monkeypatch: pytest.MonkeyPatch, says: str, fix: str) -> None:
    def refuse(*args: Any, **kwargs: Any) -> None:
        raise RuntimeError(says)

    monkeypatch.setattr(torch.version, "cuda", "12.8")
    monkeypatch.setattr(torch, "arange", refuse)
    found = find("cuda")
    assert not found.ok and says.splitlines()[0] in found.found and "\n" not in found.found
    assert found.fix.startswith(fix)


def test_no_gsplat_and_an_old_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)
    assert find("gsplat") == Check("gsplat", False, "not installed", "pip install gsplat==1.5.3 setuptools")
    old: Any = ModuleType("gsplat")
    old.__version__, old.__spec__ = "1.3.0+pt24cu124", object()
    monkeypatch.setitem(sys.modules, "gsplat", old)
    found = find("gsplat")
    assert found == Check("gsplat", False, "1.3.0+pt24cu124, 1.4.0 is needed", "pip install gsplat==1.5.3 setuptools")


@pytest.mark.parametrize("toolkit", [None, "/usr/local/cuda"])
def test_uncompiled_gsplat_is_reported(
    monkeypatch: pytest.MonkeyPatch, gpu: torch.device, tmp_path: Path, toolkit: str | None
) -> None:
    """The doctor does not start the compilation, which takes minutes."""
    pytest.importorskip("gsplat")
    from torch.utils import cpp_extension

    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    monkeypatch.setattr(cpp_extension, "CUDA_HOME", toolkit)
    monkeypatch.setattr(cpp_extension, "_jit_compile", lambda *_, **__: pytest.fail("compiles"))
    found = find("gsplat")
    assert not found.ok and "gsplat.cuda._backend" in found.fix, found
    if toolkit:
        assert "not compiled yet; nvcc is in /usr/local/cuda" in found.found and found.fix.startswith("python -c")
    else:
        assert "no nvcc found" in found.found and found.fix.startswith("install the CUDA toolkit")


def test_gsplat_check_compares_the_image(monkeypatch: pytest.MonkeyPatch, gpu: torch.device, tmp_path: Path) -> None:
    """With kernels replaced by torch: correct ones, and a wrong one."""
    pytest.importorskip("gsplat")
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    (tmp_path / "gsplat_cuda").mkdir()
    (tmp_path / "gsplat_cuda" / "gsplat_cuda.so").write_bytes(b"")
    gsplat_in_torch.install(monkeypatch)
    found = find("gsplat")
    assert found.ok and found.found.startswith("1.5.3; renders the reference image"), found
    from gsplat import rendering

    real: Callable[..., Any] = rendering.rasterize_to_pixels
    monkeypatch.setattr(rendering, "rasterize_to_pixels", lambda *a, **k: [0.9 * x for x in real(*a, **k)])
    assert "another image" in find("gsplat").found


def test_gpu_rasterizer_check(monkeypatch: pytest.MonkeyPatch, gpu: torch.device) -> None:
    def none(device: torch.device) -> Any:
        raise ClodError("no rasterizer for device cuda: move the Gaussians")

    assert find("gpu").ok
    monkeypatch.setattr(rasterizers, "for_device", none)
    found = find("gpu")
    assert (found.ok, found.found) == (False, "no rasterizer for device cuda: move the Gaussians")
    assert "pip install gsplat==1.5.3 setuptools" in found.fix
    monkeypatch.setattr(rasterizers, "for_device", lambda device: wrong)
    assert "another image" in find("gpu").found


def test_inria_check(monkeypatch: pytest.MonkeyPatch, gpu: torch.device) -> None:
    for fork in ("inria 2023", "inria 2024", None):
        installed = inria_forks.module(fork) if fork else None
        if installed:
            installed.__file__ = "/somewhere/diff_gaussian_rasterization/__init__.py"
        with monkeypatch.context() as patch:
            patch.setitem(sys.modules, "diff_gaussian_rasterization", installed)
            patch.delitem(sys.modules, "clod_adapter.integrations.inria", raising=False)
            found = find("inria")
        sys.modules.pop("clod_adapter.integrations.inria", None)
        if fork:
            assert found.ok and found.found.startswith("/somewhere/diff_gaussian_rasterization; renders the ref"), found
        else:
            assert not found.ok and "diff_gaussian_rasterization" in found.found
            assert found.fix.startswith("pip install --no-build-isolation git+https://github.com/graphdeco-inria/")


def test_processes_check(monkeypatch: pytest.MonkeyPatch) -> None:
    assert find("processes").ok and not torch.distributed.is_initialized()

    def unreachable(*_: Any) -> None:
        raise RuntimeError("gloo: no interface\nstack")

    with monkeypatch.context() as patch:
        patch.setattr(torch.distributed, "ProcessGroupGloo", unreachable)
        found = find("processes")
        assert not found.ok and "no interface" in found.found and "GLOO_SOCKET_IFNAME" in found.fix
    monkeypatch.setattr(torch.distributed, "is_available", lambda: False)
    assert "without torch.distributed" in find("processes").found


@pytest.mark.parametrize(
    ("name", "module", "packages"),
    [("plots", "matplotlib", "matplotlib"), ("glb", "pygltflib", "pygltflib"),
     ("lpips", "lpips", "lpips flip-evaluator"), ("flip", "flip_evaluator", "lpips flip-evaluator")],
)  # fmt: skip
def test_extras_that_are_not_installed(monkeypatch: pytest.MonkeyPatch, name: str, module: str, packages: str) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    found = find(name)
    assert not found.ok and found.fix == f"pip install {packages}", found


def test_splat_transform_check(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CLOD_SPLAT_TRANSFORM", raising=False)
    found = find("splat-transform")
    assert (found.ok, found.found) == (False, "splat-transform is not installed") and "npm install" in found.fix
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}/bin")
    program(tmp_path, "splat-transform", "echo 'splat-transform v3.6.0'")
    assert find("splat-transform").found == "splat-transform is 3.6.0, 3.7 or newer is needed"
    program(tmp_path, "splat-transform", 'case "$*" in *version*) echo "splat-transform v3.7.1";; *.ply) exit 3;; esac')
    found = find("splat-transform")
    assert not found.ok and "failed" in found.found
    program(tmp_path, "splat-transform", 'case "$*" in *version*) echo "splat-transform v3.7.1";; esac')
    found = find("splat-transform")
    assert found.ok and found.found.startswith("3.7.1, without a GPU")


def test_missing_weights_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    from clod_adapter.evaluation import perceptual

    def none() -> Any:
        raise perceptual.Unavailable("its network's weights are not at x", perceptual.WEIGHTS)

    monkeypatch.setitem(perceptual.METRICS, "lpips", none)
    assert find("lpips") == Check("lpips", False, "its network's weights are not at x", perceptual.WEIGHTS)
    monkeypatch.setitem(perceptual.METRICS, "lpips", lambda: lambda image, target: 0.0)
    assert "measures 0 for equal images and 0 for others" in find("lpips").found


def test_browser_check(monkeypatch: pytest.MonkeyPatch) -> None:
    def none() -> None:
        raise webbrowser.Error("could not locate runnable browser")

    monkeypatch.setattr(webbrowser, "get", none)
    found = find("browser")
    assert not found.ok and "clod-adapt view --no-browser" in found.fix and "ssh -L" in found.fix
    monkeypatch.setattr(webbrowser, "get", lambda: webbrowser.BackgroundBrowser("firefox"))
    assert find("browser") == Check("browser", True, "firefox")


def test_limits_of_a_container(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(tools, "CGROUP", tmp_path)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 2)
    unlimited = find("memory")
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    (tmp_path / "memory.max").write_text(f"{2**30}\n")
    (tmp_path / "memory.current").write_text(f"{2**28}\n")
    assert find("cores") == Check("cores", False, "2 threads on 1 cores", "OMP_NUM_THREADS=1 clod-adapt ...")
    assert unlimited.ok and find("memory").found == "0.8 GB free of 1.0 GB"
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    for name in ("cpu.max", "memory.max"):
        (tmp_path / name).write_text("max 100000\n" if name == "cpu.max" else "max\n")
    assert find("cores").ok and find("memory").found.split(" of ")[1] == unlimited.found.split(" of ")[1]


def test_a_cache_that_cannot_be_written(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    found = find("cache")
    assert found.ok and found.found.startswith(f"{tmp_path / 'cache' / 'clod-adapter'}; kernels in ")
    assert not list((tmp_path / "cache" / "clod-adapter").iterdir())
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    found = find("cache")
    assert not found.ok and found.fix.startswith("set XDG_CACHE_HOME")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    from clod_adapter._kernels import blend

    monkeypatch.setattr(blend.blend, "_cache", object())
    assert find("cache").fix.startswith("set NUMBA_CACHE_DIR")


def test_the_reference_scene_detects_small_differences() -> None:
    """A difference of 1/255 in every pixel fails; rounding passes."""
    mini = ReferenceScene.make()
    assert float((mini.image > 0.02).any(-1).float().mean()) > 0.3  # of the image is not empty
    mini.compare(mini.image + 1e-5)
    with pytest.raises(CheckFailed, match="another image"):
        mini.compare(mini.image + 1 / 255)
