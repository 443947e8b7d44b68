"""The fixture of every rasterizer."""

import pytest
import torch

import gsplat_in_torch
from backends import BACKENDS


@pytest.fixture(params=BACKENDS)
def rasterize(request, monkeypatch):
    backend = BACKENDS[request.param]
    if backend.module == "cuda":
        pytest.importorskip("gsplat", reason="pip install gsplat==1.5.3")
        if backend.device == "cpu":
            gsplat_in_torch.install(monkeypatch)
        elif not torch.cuda.is_available():
            pytest.skip("no CUDA device")
    return backend
