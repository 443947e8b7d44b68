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
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation import attenuation
from clod_adapter.equation.attenuation import attenuate
from scenes import camera

SOFT = AttenuationConfig(cut="soft", scene_distance=2.0)
DIALS = (1.0, 2.5, 6.0)


def everything_compiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compiles on the CPU too, for any number of rows, and anew."""
    monkeypatch.setattr(Fused, "compiles", lambda self, first: not self._failed)
    monkeypatch.setattr(attenuation, "_dialled", Fused(attenuation._dialled.plain))


def inputs(n: int = 3001) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(0)
    logits, sigma = 3 * torch.randn(n, generator=g), 3 * torch.rand(n, generator=g)
    logits[:3], sigma[3:6] = torch.tensor([torch.inf, -torch.inf, 0.0]), torch.tensor([0.0, 1e9, 1e-4])
    means, growth = torch.randn(n, 3, generator=g), torch.rand(n, generator=g) - 0.3
    return {"means": means, "logits": logits, "sigma": sigma, "growth": growth}


def results(given: dict[str, Tensor], form: str) -> list[Tensor]:
    """The five fields at each dial value, and their gradients of logits, sigma and growth."""
    leaves = [given[name].clone().requires_grad_() for name in ("logits", "sigma", "growth")]
    logits, sigma, growth = leaves
    d = given["means"].norm(dim=1)
    found: list[Tensor] = []
    for s in (1.0, 2.5, 6.0):
        opacities = logits.sigmoid() if form == "opacities" else logits
        where = (given["means"], camera()) if form == "seen" else d
        out = attenuate(opacities, sigma, where, s, SOFT, activated=form == "opacities", growth_d=growth)
        loss = (out.drawn * d).sum() + out.log_opacities.clamp(min=-30).sum() + (out.growth * d).sum()
        found += [*(x.detach() for x in out), *torch.autograd.grad(loss, leaves)]
    return found


COMPILER = torch.cuda.is_available() or bool(os.environ.get("CLOD_COMPILE"))


@pytest.mark.parametrize("form", ["seen", "logits", "opacities"] if COMPILER else ["seen"])
def test_one_compiled_graph_gives_the_same_results(monkeypatch: pytest.MonkeyPatch, form: str) -> None:
    """Compiled on a GPU or with CLOD_COMPILE=1; elsewhere traced, decomposed and split, as compiling takes minutes."""
    if not COMPILER:
        if not locale.getencoding().upper().startswith("UTF"):
            pytest.skip("torch's compiler reads files of its own, which are UTF-8, in the locale's encoding")
        compile_, backend = torch.compile, "aot_eager_decomp_partition"
        monkeypatch.setattr(torch, "compile", lambda f, **kwargs: compile_(f, backend=backend, **kwargs))
    given = {name: value.to("cuda" if torch.cuda.is_available() else "cpu") for name, value in inputs().items()}
    want = results(given, form)
    everything_compiles(monkeypatch)
    torch._dynamo.utils.counters.clear()
    found = results(given, form)
    assert torch._dynamo.utils.counters["stats"]["unique_graphs"] == 1  # of three dial values
    assert not attenuation._dialled._failed and attenuation._dialled._compiled is not None
    for mine, expected in zip(found, want, strict=True):  # to rounding: torch versions fuse different operations
        torch.testing.assert_close(mine.float(), expected.float(), rtol=1e-5, atol=1e-6, equal_nan=True)


def test_a_failure_to_compile_warns_once_and_falls_back(monkeypatch: pytest.MonkeyPatch) -> None:
    want = results(inputs(), "logits")
    everything_compiles(monkeypatch)

    def fail(error: Exception) -> Any:
        raise error

    monkeypatch.setattr(torch, "compile", lambda f, **_: lambda *a, **k: fail(RuntimeError("triton not found\nmore")))
    with pytest.warns(UserWarning, match=r"torch.compile fails here \(triton not found\)") as seen:
        found = results(inputs(), "logits")
    assert len([w for w in seen if "torch.compile" in str(w.message)]) == 1
    assert all(torch.equal(a, b) for a, b in zip(found, want, strict=True))
    fused = Fused(lambda x: x)  # running out of memory is not a failure to compile
    monkeypatch.setattr(fused, "_compiled", lambda *_: fail(torch.cuda.OutOfMemoryError("full")))
    with pytest.raises(torch.cuda.OutOfMemoryError):
        fused.compiled(torch.zeros(1))
    assert not fused._failed
