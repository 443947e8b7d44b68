"""Fixtures of every rasterizer, and of the number of threads."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

import gsplat_in_torch
from backends import BACKENDS, Backend, torch_threads


@pytest.fixture(params=BACKENDS)
def rasterize(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Backend:
    backend = BACKENDS[request.param]
    if backend.module == "cuda":
        pytest.importorskip("gsplat", reason="pip install gsplat==1.5.3")
        if backend.device == "cpu":
            gsplat_in_torch.install(monkeypatch)
        elif not torch.cuda.is_available():
            pytest.skip("no CUDA device")
    return backend


@pytest.fixture(params=[1, 2])
def one_or_two_threads(request: pytest.FixtureRequest) -> Iterator[None]:
    with torch_threads(request.param):
        yield
