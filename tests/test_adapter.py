"""The adapter reproduces the result, can be removed exactly, identifies its base, and is written as
a tensor file.
"""

import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused
from safetensors import safe_open
from safetensors.torch import load_file, save_file

from clod_adapter import AttenuationConfig, Gaussians
from clod_adapter import adapter as adapters
from clod_adapter.adapter import ATTRIBUTES, DIAL, SIGMA_MAX, Adapter, detach, with_dial
from clod_adapter.io.adapter_file import load_adapter, save_adapter
from clod_adapter.io.tensor_file import read_tensors, write_tensors
from formats import examples
from scenes import seeded

CONFIG = AttenuationConfig(reference_distance=3.5)
extract = partial(adapters.extract, fingerprint="a" * 64, config={})


def gaussians(n=6, seed=0, bands=8):
    """The first is opaque, at -0 and at denormal coordinates."""
    g = seeded(seed)
    shapes = ((n, 3), (n, 4), (n, 3), (n,), (n, 1, 3), (n, bands, 3))
    made = Gaussians(*(torch.randn(shape, generator=g) for shape in shapes))
    made.opacity_logits[0], made.means[0] = torch.inf, torch.tensor([-0.0, 0.0, 1e-42])
    return made


def bits(g):
    return {
        name: value.detach().view(torch.int32).flatten().tolist()
        for name, value in g.tensors().items()
    }


def adapt(base, names, scale=0.01, seed=1, growth=True):
    """With other values of these attributes, but in the first row."""
    g = seeded(seed)
    changes = {name: getattr(base, name).clone() for name in names}
    for values in changes.values():
        values[1:] += scale * torch.randn(values[1:].shape, generator=g)
    sigma_d, growth_d = torch.rand(2, len(base), generator=g)
    return with_dial(base.replace(**changes), sigma_d, CONFIG, growth_d if growth else None)


@examples(30)
@given(
    st.lists(st.sampled_from(ATTRIBUTES), unique=True),
    st.sampled_from([1e-9, 1e-3, 1.0, 1e4, 1e6]),
    st.integers(0, 1000),
    st.sampled_from([0, 3, 15]),
    st.booleans(),
)
def test_applying_an_adapter_gives_the_result(names, scale, seed, bands, growth):
    base = gaussians(seed=seed, bands=bands)
    adapted = adapt(base, names, scale, seed + 1, growth)
    before = bits(base)
    adapter = extract(base, adapted)
    result = adapter.apply(base, "a" * 64)
    assert bits(adapter.apply(base)) == bits(result) and bits(base) == before
    assert result.attenuation == CONFIG and adapter.sigma_d is not adapted.sigma_d
    assert all(bits(result).get(name) == bits(adapted).get(name) for name in DIAL)
    # Extracting the result from itself changes nothing any more.
    assert bits(extract(base, result).apply(base)) == bits(result)
    assert bits(detach(result)[:1]) == bits(base[:1])
    for name in ATTRIBUTES:
        old, new, found = (getattr(each, name)[1:] for each in (base, adapted, result))
        assert name in names or getattr(result, name) is getattr(base, name)
        assert ((found - new).abs() <= 2.0**-10 * (new - old).abs() + 1e-6).all()


@pytest.mark.parametrize(
    "unit, step, dtype",
    [(1.0, 0.01, torch.float16), (1.0, 1e6, torch.float32), (1e-4, 1e-7, torch.float32)],
)
def test_the_type_of_a_difference(unit, step, dtype):
    """Differences in float16; new values in float32 where a difference overflows or underflows
    float16.
    """
    base = gaussians(50)
    base = base.replace(means=unit * base.means)
    adapted = adapt(base, ["means"], step)
    adapter = extract(base, adapted)
    assert {name: update.dtype for name, update in adapter.updates.items()} == {"means": dtype}
    if dtype == torch.float32:
        assert bits(adapter.apply(base))["means"] == bits(adapted)["means"]


def test_with_dial_and_detach():
    """Without sigma_d the dial has no effect and can be removed exactly; with it, its tensor is
    used as it is.
    """
    base = gaussians()
    sigma_d = torch.rand(6)
    on = with_dial(base)
    chosen = with_dial(base, sigma_d, CONFIG)
    assert on.attenuation == with_dial(base, sigma_d).attenuation == AttenuationConfig()
    assert (on.sigma_d == SIGMA_MAX).all()
    assert chosen.sigma_d is sigma_d and chosen.attenuation is CONFIG
    grown = with_dial(base, sigma_d, CONFIG, torch.rand(6))
    assert detach(grown) == detach(on) == base and with_dial(grown, sigma_d, CONFIG) == chosen


def test_extracting_ignores_a_dial_of_the_base_and_drops_graphs():
    base = gaussians()
    old = with_dial(base, torch.ones(6), growth_d=torch.ones(6))
    leaves = {name: torch.rand(6).requires_grad_() for name in DIAL}
    result = adapt(base, ["sh0"]).replace(sh0=(base.sh0 + 1).requires_grad_(), **leaves)
    fresh = extract(base, result)
    again = extract(old, result.replace(growth_d=None))
    assert bits(fresh.apply(old)) == bits(fresh.apply(base)) and again.apply(old).growth_d is None
    assert not any(value.requires_grad for value in fresh.apply(base).tensors().values())


def test_other_input_is_refused():
    base = gaussians()
    full = partial(torch.full, (6,))
    adapter = extract(base, adapt(base, ["shN"]))
    infinite = base.replace(sh0=torch.full((6, 1, 3), torch.inf))
    grown = with_dial(base, full(1.0), growth_d=full(torch.inf))
    for message, call in {
        "different base.*SHA-256 bbbb": lambda: adapter.apply(base, "b" * 64),
        "different base.*7 Gaussians, the adapter 6": lambda: adapter.apply(gaussians(7)),
        "different base.*shN": lambda: adapter.apply(gaussians(bands=3)),
        "no sigma_d": lambda: extract(base, base),
        "means is float32": lambda: extract(base, with_dial(gaussians(5))),
        "sigma_d holds .* diverged": lambda: extract(base, with_dial(base, full(torch.nan))),
        "growth_d holds": lambda: extract(base, grown),
        "sh0 holds a new": lambda: extract(base, with_dial(infinite)),
        "'colour'": lambda: replace(adapter, updates={"colour": torch.ones(6)}),
    }.items():
        with refused(message):
            call()


def test_arrays_become_tensors_and_repr_is_short():
    base = gaussians()
    columns = {"sigma_d": np.ones(6, np.float32), "growth_d": np.zeros(6, np.float32)}
    update = {"means": np.full((6, 3), 0.5, np.float16)}
    adapter = Adapter(**columns, attenuation=CONFIG, updates=update, base_fingerprint="", config={})
    torch.testing.assert_close(adapter.apply(base).means, base.means + 0.5)
    assert repr(adapter) == "Adapter(6 Gaussians, dial to 5 with growth, updates of means)"


STORED = {"steps": 3, "lr": 0.1, "names": ["a", None], "nested": {"b": True}, "ü": "é"}


def adapter(n=5, config=None, reference=0.1 / 3):
    generator = seeded(n)
    updates = {
        "means": torch.randn(n, 3, generator=generator).half(),
        "opacity_logits": torch.randn(n, generator=generator),
        "shN": torch.zeros(n, 0, 3).half(),
    }
    attenuation = AttenuationConfig(reference_distance=np.float64(reference), max_sv=7.0)
    return Adapter(
        torch.rand(n, generator=generator), attenuation, updates, "ab" * 32, config or {}
    )


@examples(25)
@given(st.integers(0, 20), st.floats(0, 1e30), st.booleans())
def test_adapter_round_trips(tmp_path, n, reference, growth):
    first = tmp_path / "a.safetensors"
    second = tmp_path / "b.safetensors"
    growth_d = torch.linspace(-1, 3, n) if growth else None
    saved = replace(adapter(n, STORED, reference), growth_d=growth_d)
    save_adapter(first, saved)
    loaded = load_adapter(str(first))
    assert loaded.attenuation == saved.attenuation and loaded.config == STORED
    assert loaded.base_fingerprint == "ab" * 32 and torch.equal(loaded.sigma_d, saved.sigma_d)
    assert torch.equal(loaded.growth_d, growth_d) if growth else loaded.growth_d is None
    assert loaded.updates.keys() == saved.updates.keys()
    for name, update in saved.updates.items():
        again = loaded.updates[name]
        assert again.dtype == update.dtype and torch.equal(again, update)
    save_adapter(second, loaded)
    assert first.read_bytes() == second.read_bytes()


def test_tensor_files_are_safetensors(tmp_path):
    """Types in any order, a transposed and an empty tensor, a scalar, text that is not ASCII; for
    all to read.
    """
    tensors = {
        "mask": torch.tensor([True, False, True]),
        "bytes": torch.arange(5, dtype=torch.uint8),
        "half": torch.randn(3).half(),
        "means": torch.randn(3, 2).T,
        "none": torch.zeros(0, 3),
        "one": torch.tensor(2.5),
        "long": torch.arange(2),
        "double": torch.randn(2, dtype=torch.float64),
    }
    metadata = {"about": 'a "quoted" é'}
    write_tensors(tmp_path / "a", tensors, metadata)
    found, about = read_tensors(tmp_path / "a")
    assert about == metadata and found.keys() == tensors.keys()
    for name, tensor in load_file(tmp_path / "a").items():
        assert torch.equal(tensor, tensors[name]) and torch.equal(found[name], tensor)
    (tmp_path / "b").touch()
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


# of tensors, None for one that is absent, or of settings
CHANGES = (
    ({"extra": torch.ones(5)}, "updates has 'extra'"),
    ({"means": torch.ones(4, 3)}, "5 rows"),
    ({"means": torch.ones(5, 3, dtype=torch.int32)}, "float16 or float32"),
    ({"sigma_d": None}, "sigma_d"),
    ({"sigma_d": torch.full((5,), torch.nan)}, "not finite"),
    ({"sigma_d": torch.ones(5, 1)}, "float32"),
    ({"growth_d": torch.full((5,), torch.inf)}, "growth_d holds a value that is not finite"),
    ({"growth_d": torch.ones(4)}, r"growth_d is float32 \[4\], it must be float32 \[5\]"),
    ({"format": "else"}, "is not an adapter but 'else'"),
    ({"base_sha256": 5}, "base_sha256 is 5"),
    ({"package_version": "1\n2"}, "printable"),
    ({"format_version": "x"}, "settings are damaged"),
    ({"config": [1]}, "config is .1., not a dict"),
)


def test_invalid_files_are_refused(tmp_path):
    path = tmp_path / "a"
    save_adapter(path, adapter())
    with safe_open(path, framework="pt") as file:
        about = json.loads(file.metadata()["clod_adapter"])
        tensors = load_file(path)
    assert about["format"] == "clod-adapter"
    assert about["format_version"] == 3
    assert "package_version" in about
    assert about["base_sha256"] == "ab" * 32
    assert about["attenuation"]["reference_distance"] == 0.1 / 3

    def rejected(message, tensors, text):
        save_file(tensors, path, text and {"clod_adapter": text})
        with refused(message):
            load_adapter(path)

    for change, message in CHANGES:
        if change.keys() <= about.keys():
            rejected(message, tensors, json.dumps(about | change))
        else:
            changed = (tensors | change).items()
            present = {name: value for name, value in changed if value is not None}
            rejected(message, present, json.dumps(about))
    for text in ("[" * 100_000, '{"format": ' * 50_000, "1" * 10_000, "nul", '"\\ud800"'):
        rejected("settings are damaged", tensors, text)
    rejected("not an adapter", tensors, None)


def test_config_must_be_json_and_version_is_kept(tmp_path):
    for value in ({1, 2}, torch.ones(1), float("nan"), object()):
        with refused("not plain JSON"):
            save_adapter(tmp_path / "a", adapter(config={"x": value}))
    assert list(tmp_path.iterdir()) == []
    save_adapter(tmp_path / "a", replace(adapter(), version="7.8.9"))
    assert load_adapter(tmp_path / "a").version == "7.8.9"
