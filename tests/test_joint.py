"""One function decides what is drawn: change its threshold or its growth, and everything that uses a dial follows."""

import pytest

from clod_adapter.equation import attenuation, growth
from clod_adapter.rasterizers import BACKENDS, Rasterizer, cpu
from consumers import CONSUMERS, model_of, same

TAU, RAISED = 0.02, 0.2
# Growth is no part of the culling rule, and none of the paper's form.
WITHOUT_GROWTH = {"the paper's objective", "order_by_extinction", *(n for n in CONSUMERS if n.startswith("dial_for"))}


@pytest.mark.parametrize("name", CONSUMERS)
def test_everything_follows_the_culling_threshold(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A threshold of 10 tau s gives, to the bit, what a tenfold tau gives."""
    consumer = CONSUMERS[name]
    before, wanted = consumer(model_of(TAU)), consumer(model_of(RAISED))
    assert not same(before, wanted)
    # The function's own code, as an edit of its source would change it for whoever has imported it.
    changed = (lambda tau, virtual_scale: (10 * tau) * virtual_scale).__code__
    monkeypatch.setattr(attenuation.culling_threshold, "__code__", changed)
    assert 10 * TAU == RAISED and same(consumer(model_of(TAU)), wanted)


@pytest.mark.parametrize("name", CONSUMERS)
def test_everything_grows_by_one_function(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other factors change whatever draws, and nothing that counts or culls.

    By the default ``draw``: the CPU's kernels override it (tests/rasterizers/test_dial.py compares the two).
    """
    monkeypatch.setitem(BACKENDS, "cpu", lambda: Rasterizer(cpu.rasterize))
    consumer = CONSUMERS[name]
    before = consumer(model_of(TAU))
    changed = (lambda growth_d, d, s, r: (3 * growth_d.to(d)).exp()).__code__
    monkeypatch.setattr(growth.growth_factors, "__code__", changed)
    assert same(consumer(model_of(TAU)), before) == (name in WITHOUT_GROWTH)
