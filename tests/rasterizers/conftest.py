"""The rasterizers under contract. A new backend is a line in BACKENDS."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from clod_adapter.rasterizers import Rasterizer

# Module below clod_adapter.rasterizers, and the device it works on.
BACKENDS = {"cpu": "cpu"}


@pytest.fixture(params=BACKENDS)
def rasterize(request: pytest.FixtureRequest) -> Rasterizer:
    """A backend that takes and returns CPU tensors, wherever it works."""
    device = BACKENDS[request.param]
    if device == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")
    backend = importlib.import_module(f"clod_adapter.rasterizers.{request.param}").rasterize

    def moved(*args: Any, **kwargs: Any) -> tuple[Tensor, Tensor]:
        def place(x: Any) -> Any:
            return x.to(device) if isinstance(x, Tensor) else x

        image, alpha = backend(*map(place, args), **{name: place(value) for name, value in kwargs.items()})
        return image.cpu(), alpha.cpu()

    return moved


@pytest.fixture(params=[1, 2])
def torch_threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)
