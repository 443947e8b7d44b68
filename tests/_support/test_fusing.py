"""Compiled formulas match the plain ones in values and gradients; one compilation serves all dial values."""

from __future__ import annotations

import locale
import os
from typing import Any

import pytest
import torch
import torch._functorch.config
from torch import Tensor

from clod_adapter._support.fusing import Fused
from clod_adapter.cameras import Camera
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation import attenuation
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.training import optimizer
from scenes import camera

SOFT = AttenuationConfig(cut="soft", scene_distance=2.0)
DIALS = (1.0, 2.5, 6.0)


@pytest.fixture
def everything_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiles on the CPU too, for any number of rows, and anew in each test."""
    monkeypatch.setattr(Fused, "compiles", lambda self, first: not self._failed)
    monkeypatch.setattr(attenuation, "_dialled", Fused(attenuation._dialled.plain))
    monkeypatch.setattr(optimizer, "_adam", Fused(optimizer._adam.plain))


def faster(monkeypatch: pytest.MonkeyPatch) -> None:
    """Traces, decomposes and splits into forward and backward, without a compiler, which takes minutes."""
    if not locale.getencoding().upper().startswith("UTF"):
        pytest.skip("torch's compiler reads files of its own, which are UTF-8, in the locale's encoding")
    compile_, backend = torch.compile, "aot_eager_decomp_partition"
    monkeypatch.setattr(torch, "compile", lambda f, **kwargs: compile_(f, backend=backend, **kwargs))


def inputs(n: int = 3001) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(0)
    logits, sigma = 3 * torch.randn(n, generator=g), 3 * torch.rand(n, generator=g)
    logits[:3], sigma[3:6] = torch.tensor([torch.inf, -torch.inf, 0.0]), torch.tensor([0.0, 1e9, 1e-4])
    means, growth = torch.randn(n, 3, generator=g), torch.rand(n, generator=g) - 0.3
    return {"means": means, "logits": logits, "sigma": sigma, "growth": growth}


def results(given: dict[str, Tensor], view: Camera, config: AttenuationConfig, form: str) -> list[Tensor]:
    """The five fields at each dial value, and their gradients of logits, sigma and growth."""
    leaves = [given[name].clone().requires_grad_() for name in ("logits", "sigma", "growth")]
    logits, sigma, growth = leaves
    d = given["means"].norm(dim=1)
    found: list[Tensor] = []
    for s in DIALS:
        if form == "seen":
            out = attenuate(logits, sigma, (given["means"], view), s, config, growth_d=growth)
        elif form == "logits":
            out = attenuate(logits, sigma, d, s, config, growth_d=growth)
        else:
            out = attenuate(logits.sigmoid(), sigma, d, s, config, activated=True, growth_d=growth)
        loss = (out.drawn * d).sum() + out.log_opacities.clamp(min=-30).sum() + (out.growth * d).sum()
        found += [*(x.detach() for x in out), *torch.autograd.grad(loss, leaves)]
    return found


def test_one_traced_graph_gives_the_same_results(
    monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    def donates() -> Any:
        """A global setting of torch, which must not change; torch 2.4 does not have it."""
        return getattr(torch._functorch.config, "donated_buffer", None)

    before = donates()
    want = results(inputs(), camera(), SOFT, "seen")
    request.getfixturevalue("everything_compiles")
    faster(monkeypatch)
    torch._dynamo.utils.counters.clear()
    found = results(inputs(), camera(), SOFT, "seen")
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == 1  # of three dial values
    assert not attenuation._dialled._failed and attenuation._dialled._compiled is not None
    assert_same(found, want)
    assert donates() == before


@pytest.mark.skipif(
    not (torch.cuda.is_available() or os.environ.get("CLOD_COMPILE")),
    reason="compiling takes minutes on a busy machine: done on a GPU, or with CLOD_COMPILE=1",
)
@pytest.mark.parametrize("form", ["seen", "logits", "opacities"])
def test_compiled_results_are_the_same_to_rounding(request: pytest.FixtureRequest, form: str) -> None:
    where = "cuda" if torch.cuda.is_available() else "cpu"
    given = {name: value.to(where) for name, value in inputs().items()}
    want = results(given, camera(), SOFT, form)
    request.getfixturevalue("everything_compiles")
    assert_same(results(given, camera(), SOFT, form), want)
    assert not attenuation._dialled._failed and attenuation._dialled._compiled is not None


def assert_same(found: list[Tensor], want: list[Tensor]) -> None:
    """Asserts equality to rounding: torch versions fuse different operations."""
    for mine, expected in zip(found, want, strict=True):
        torch.testing.assert_close(mine.float(), expected.float(), rtol=1e-5, atol=1e-6, equal_nan=True)


def test_a_failure_to_compile_warns_once_and_falls_back(
    monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    want = results(inputs(), camera(), SOFT, "logits")
    request.getfixturevalue("everything_compiles")

    def fail(error: Exception) -> Any:
        raise error

    monkeypatch.setattr(torch, "compile", lambda f, **_: lambda *a, **k: fail(RuntimeError("triton not found\nmore")))
    with pytest.warns(UserWarning, match=r"torch.compile fails here \(triton not found\)") as seen:
        found = results(inputs(), camera(), SOFT, "logits")
    assert len([w for w in seen if "torch.compile" in str(w.message)]) == 1
    assert all(torch.equal(a, b) for a, b in zip(found, want, strict=True))
    fused = Fused(lambda x: x)  # running out of memory is not a failure to compile
    monkeypatch.setattr(fused, "_compiled", lambda *_: fail(torch.cuda.OutOfMemoryError("full")))
    with pytest.raises(torch.cuda.OutOfMemoryError):
        fused.compiled(torch.zeros(1))
    assert not fused._failed
