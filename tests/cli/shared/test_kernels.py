"""Kernels are compiled before any measurement of time, with a message."""

from __future__ import annotations

import importlib
import pkgutil
import re
from typing import Any

import numba
import pytest
from numba.core.dispatcher import Dispatcher

import clod_adapter
from clod_adapter import _kernels
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.shared.inputs import OTHER, SHARES, announced_compiling, prepare_kernels


def kernels() -> dict[str, Dispatcher]:
    """The kernels that Python calls, by name."""
    modules = [
        importlib.import_module(f"{_kernels.__name__}.{m.name}") for m in pkgutil.iter_modules(_kernels.__path__)
    ]
    found = [value for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)]
    return {d.py_func.__name__: d for d in found if not d.targetoptions.get("forceinline")}


def test_adapting_compiles_nothing_more(capture: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """For any SH degree; without compiling nothing is printed."""
    base, scene = capture.gaussians, clod_adapter.load_scene(capture.scene)
    prepare_kernels(Console(quiet=True))
    prepare_kernels(Console())
    assert capsys.readouterr().err == ""
    before = {name: len(kernel.signatures) for name, kernel in kernels().items()}
    assert min(before.values()) >= 1, before
    for bands in (0, 3):
        base = base.replace(shN=base.shN[:, :bands])
        result = clod_adapter.adapt(base, scene, clod_adapter.AdaptConfig(iters=2)).gaussians
        clod_adapter.evaluate(result, scene.test, [1.0, 3.0])
    assert {name: len(kernel.signatures) for name, kernel in kernels().items()} == before


def test_shares_name_kernels() -> None:
    assert set(SHARES) - {OTHER} < set(kernels())
    prepare_kernels(Console(quiet=True))
    times = {name: 1 + name.startswith("project") for name in kernels()}
    assert all(times[name] <= len(kernel.signatures) for name, kernel in kernels().items())
    assert sum(SHARES.get(name, SHARES[OTHER]) * times[name] for name in times) == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("kept", [True, False])
def test_compiling_is_announced_once(kept: bool, capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    monkeypatch.setattr("clod_adapter.cli.shared.console.LINE_EVERY", 0)
    inner = numba.njit(lambda x: x + 1)
    function = numba.njit(lambda x: inner(x))
    monkeypatch.setattr("clod_adapter.cli.shared.inputs.NullCache", () if kept else object)
    with announced_compiling(Console(), {OTHER: 0.25}):
        function(1)
        function(1.0)
    said, *progress = capsys.readouterr().err.splitlines()
    why = "first run only, well under a minute" if kept else "on every run, .* set NUMBA_CACHE_DIR"
    assert re.fullmatch(rf"compiling kernels \({why}\) \.\.\.", said)
    assert [line.split(",")[0] for line in progress] == [
        "compiling  25%",
        "compiling  50%",
    ]  # without the inner function
