"""The adapter reproduces the result, can be removed exactly, and identifies its base."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from clod_adapter.adapter import ATTRIBUTES, DIAL, SIGMA_MAX, Adapter, detach, extract, trim, with_dial
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import Gaussians

CONFIG = AttenuationConfig(tau=0.01, reference_distance=3.5)


def gaussians(n: int = 6, seed: int = 0, bands: int = 8) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, 1, 3), (n, bands, 3))
    return Gaussians(*(torch.randn(shape, generator=g) for shape in shapes))


def bits(g: Gaussians) -> dict[str, list[int]]:
    return {name: value.detach().view(torch.int32).flatten().tolist() for name, value in g.tensors().items()}


def adapt(base: Gaussians, names: list[str], scale: float = 0.01, seed: int = 1, growth: bool = True) -> Gaussians:
    g = torch.Generator().manual_seed(seed)
    changes = {}
    for name in names:
        old = getattr(base, name)
        changes[name] = old + scale * torch.randn(old.shape, generator=g)
    sigma_d, growth_d = torch.rand(2, len(base), generator=g)
    return with_dial(base.replace(**changes), sigma_d, CONFIG, growth_d if growth else None)


@settings(deadline=None)
@given(
    st.lists(st.sampled_from(ATTRIBUTES), unique=True), st.sampled_from([1e-9, 1e-3, 1.0, 1e4, 1e6]),
    st.integers(0, 1000), st.sampled_from([0, 3, 15]), st.booleans(),
)  # fmt: skip
def test_applying_an_adapter_gives_the_result(
    names: list[str], scale: float, seed: int, bands: int, growth: bool
) -> None:
    base = gaussians(seed=seed, bands=bands)
    adapted = adapt(base, names, scale, seed + 1, growth)
    before = bits(base)
    adapter = extract(base, adapted, fingerprint="f", config={"steps": 1})
    result = adapter.apply(base, "f")
    assert bits(adapter.apply(base)) == bits(result) and bits(base) == before
    assert result.attenuation == CONFIG and adapter.sigma_d is not adapted.sigma_d
    assert all(bits(result).get(name) == bits(adapted).get(name) for name in DIAL)
    assert ("growth_d" in bits(result)) == growth
    # Extracting the result from itself changes nothing any more.
    assert bits(extract(base, result, fingerprint="f", config={}).apply(base)) == bits(result)
    for name in ATTRIBUTES:
        if name not in names:
            assert name not in adapter.updates and getattr(result, name) is getattr(base, name)
        step = 2.0**-10 * (getattr(adapted, name) - getattr(base, name)).abs() + 1e-6
        assert ((getattr(result, name) - getattr(adapted, name)).abs() <= step).all()


@pytest.mark.parametrize(
    ("unit", "step", "dtype"),
    [(1.0, 0.01, torch.float16), (1.0, 1e6, torch.float32), (1e-4, 1e-7, torch.float32)],
    ids=["half the size", "overflow", "underflow"],
)
def test_the_type_of_a_difference(unit: float, step: float, dtype: torch.dtype) -> None:
    """Differences in float16; new values in float32 where a difference overflows or underflows float16."""
    base = gaussians(50)
    base = base.replace(means=unit * base.means)
    adapted = adapt(base, ["means"], step)
    adapter = extract(base, adapted, fingerprint="f", config={})
    assert {name: update.dtype for name, update in adapter.updates.items()} == {"means": dtype}
    assert dtype == torch.float16 or bits(adapter.apply(base))["means"] == bits(adapted)["means"]


def test_infinite_logits() -> None:
    base = gaussians()
    base.opacity_logits[0] = torch.inf
    stays = adapt(base, ["opacity_logits"])
    adapter = extract(base, stays, fingerprint="f", config={})
    assert adapter.updates["opacity_logits"].dtype == torch.float16
    assert adapter.apply(base).opacity_logits[0] == torch.inf
    logits = stays.opacity_logits.clone()
    logits[0] = 5.0
    adapter = extract(base, stays.replace(opacity_logits=logits), fingerprint="f", config={})
    assert adapter.updates["opacity_logits"].dtype == torch.float32
    assert torch.equal(adapter.apply(base).opacity_logits, logits)


def test_unchanged_values_keep_their_bits() -> None:
    base = gaussians()
    base.means[0] = torch.tensor([-0.0, 0.0, 1e-42])
    means = base.means.clone()
    means[1] += 1
    result = extract(base, with_dial(base.replace(means=means)), fingerprint="f", config={}).apply(base)
    assert bits(result)["means"][:3] == bits(base)["means"][:3]


def test_with_dial_and_detach() -> None:
    """Without sigma_d the dial has no effect and can be removed exactly; with it, its tensor is used as it is."""
    base, sigma_d = gaussians(), torch.rand(6)
    on, chosen = with_dial(base), with_dial(base, sigma_d, CONFIG)
    assert on.attenuation == AttenuationConfig(tau=1 / 255, cut="hard") and bits(detach(on)) == bits(base)
    assert detach(on).sigma_d is None and detach(on).attenuation is None
    grown = with_dial(base, sigma_d, CONFIG, torch.rand(6))
    assert bits(detach(grown)) == bits(base) and bits(with_dial(grown, sigma_d, CONFIG)) == bits(chosen)
    assert (on.sigma_d == SIGMA_MAX).all() and with_dial(base, sigma_d).attenuation == AttenuationConfig()
    distance = torch.logspace(-6, 4, 1000)
    for sigma in (torch.tensor(SIGMA_MAX), torch.tensor(SIGMA_MAX, dtype=torch.float64)):
        assert (torch.exp(-(distance**2) / (2 * sigma**2 + 1e-8)).float() == 1).all()
    assert chosen.sigma_d is sigma_d and chosen.attenuation is CONFIG
    with pytest.raises(ClodError, match="sigma_d"):
        with_dial(base, torch.rand(5), CONFIG)


def test_extracting_ignores_a_dial_of_the_base_and_drops_graphs() -> None:
    base = gaussians()
    old = with_dial(base, torch.ones(6), growth_d=torch.ones(6))
    leaves = {name: torch.rand(6).requires_grad_() for name in DIAL}
    adapted = adapt(base, ["sh0"]).replace(sh0=(base.sh0 + 1).requires_grad_(), **leaves)
    for result in (adapted, adapted.replace(growth_d=None)):
        fresh, again = (extract(each, result, fingerprint="f", config={}) for each in (base, old))
        assert bits(fresh.apply(old)) == bits(again.apply(base))
        assert not fresh.sigma_d.requires_grad and not fresh.updates["sh0"].requires_grad
        assert fresh.growth_d is None or not fresh.growth_d.requires_grad


def test_a_different_base_is_refused() -> None:
    base = gaussians()
    adapter = extract(base, adapt(base, ["shN"]), fingerprint="a" * 64, config={})
    with pytest.raises(ClodError, match="different base.*SHA-256 is bbbb"):
        adapter.apply(base, "b" * 64)
    with pytest.raises(ClodError, match="different base.*7 Gaussians, the adapter 6"):
        adapter.apply(gaussians(7))
    with pytest.raises(ClodError, match="different base.*shN"):
        adapter.apply(gaussians(bands=3))


def test_extract_refuses_other_results() -> None:
    base = gaussians()
    with pytest.raises(ClodError, match="no sigma_d"):
        extract(base, base, fingerprint="f", config={})
    with pytest.raises(ClodError, match="means is float32"):
        extract(base, with_dial(gaussians(5)), fingerprint="f", config={})
    with pytest.raises(ClodError, match="diverged"):
        extract(base, with_dial(base, torch.full((6,), torch.nan)), fingerprint="f", config={})
    with pytest.raises(ClodError, match="growth_d holds a value that is not finite"):
        extract(base, with_dial(base, torch.ones(6), growth_d=torch.full((6,), torch.inf)), fingerprint="f", config={})
    for bad in (torch.nan, torch.inf):
        with pytest.raises(ClodError, match="sh0 holds a new value"):
            extract(base, with_dial(base.replace(sh0=torch.full((6, 1, 3), bad))), fingerprint="f", config={})


def test_an_adapter_checks_its_fields() -> None:
    with pytest.raises(ClodError, match=r"sigma_d is float64 \[3\], it must be float32 \[3\]"):
        Adapter(torch.ones(3).double(), CONFIG, {}, "f", {})
    for growth_d in (torch.ones(4), torch.ones(3, 1), torch.ones(3).half()):
        with pytest.raises(ClodError, match=r"growth_d is .*, it must be float32 \[3\]"):
            Adapter(torch.ones(3), CONFIG, {}, "f", {}, growth_d=growth_d)
    with pytest.raises(ClodError, match="'colour'"):
        Adapter(torch.ones(3), CONFIG, {"colour": torch.ones(3)}, "f", {})
    for bad in ("1.0\nproperty float x", "1.0ä"):
        with pytest.raises(ClodError, match="version"):
            Adapter(torch.ones(3), CONFIG, {}, "f", {}, bad)
    adapter = extract(gaussians(3), with_dial(gaussians(3)), fingerprint="f", config={})
    for kept in (torch.ones(4, dtype=torch.bool), torch.ones(3), torch.ones(3, 1, dtype=torch.bool)):
        with pytest.raises(ClodError, match="Adapter.kept is .* it must be bool with 3 set"):
            replace(adapter, kept=kept)
    with pytest.raises(ClodError, match="Adapter.sh_degree is 7"):
        replace(adapter, sh_degree=7)


@pytest.mark.parametrize("degree", [None, 1, 0])
def test_a_trimmed_result(degree: int | None) -> None:
    base = gaussians(7, bands=8)
    kept = torch.arange(7) % 2 == 0
    less = trim(base, kept, degree)
    assert len(less) == 4 and less.sh_degree == (2 if degree is None else degree)
    adapted = adapt(less, ["means", "shN"] if degree else ["means"])
    adapter = replace(extract(less, adapted, fingerprint="f", config={}), kept=kept, sh_degree=degree)
    assert bits(adapter.apply(base)) == bits(replace(adapter, kept=None, sh_degree=None).apply(less))
    with pytest.raises(ClodError, match="it has 4 Gaussians, the adapter 7"):
        adapter.apply(less)
    if degree == 1:
        with pytest.raises(ClodError, match="it has SH degree 0, the adapter 1"):
            adapter.apply(base.without_bands(0))


def test_arrays_become_tensors_and_repr_is_short() -> None:
    base = gaussians()
    columns = {"sigma_d": np.ones(6, np.float32), "growth_d": np.zeros(6, np.float32)}
    update = {"means": np.full((6, 3), 0.5, np.float16)}
    adapter = Adapter(**columns, attenuation=CONFIG, updates=update, base_fingerprint="", config={})
    torch.testing.assert_close(adapter.apply(base).means, base.means + 0.5)
    assert repr(adapter) == f"Adapter(6 Gaussians, dial to {CONFIG.max_sv:g} with growth, updates of means)"
