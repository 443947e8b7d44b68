"""The code and the defaults in docs/writing_a_renderer.md."""

import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import torch

import clod_adapter
import scenes
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import attenuate, growth_factors
from clod_adapter.hook import Hook

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "writing_a_renderer.md").read_text(encoding="utf-8")


def my_opacity(opacity: float, sigma: float, d: float, scale: float, eps: float, tau: float, soft: bool) -> float:
    config = AttenuationConfig(eps=eps, tau=tau, cut="soft" if soft else "hard", max_sv=1)
    return float(attenuate(*torch.tensor([[opacity], [sigma], [d]]), scale, config, activated=True).drawn)


def my_scale(growth: float, distance: float, scale: float, reach: float) -> float:
    return float(growth_factors(*torch.tensor([[growth], [distance]]), scale, reach))


def block(word: str) -> str:
    (found,) = (text for text in re.findall(r"```python\n(.*?)```", PAGE, re.S) if word in text)
    return str(found)


def test_the_code_of_the_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The golden loop, which refuses functions that are off; the hook; and a held frame time, with 20 ms a frame."""
    monkeypatch.chdir(tmp_path)
    adapted = scenes.dialled(300, 1, 3, scene_distance=1.0, reference_distance=5.0).replace(
        growth_d=torch.linspace(0, 1, 300)
    )
    clod_adapter.save("model.ply", adapted)
    own = {"my_opacity": my_opacity, "my_scale": my_scale}
    exec(block("golden"), dict(own))
    for name, function in own.items():
        with pytest.raises(AssertionError):
            exec(block("golden"), own | {name: lambda *row, function=function: function(*row) * 1.001})
    names: dict[str, Any] = {"means": adapted.means, "opacities": adapted.opacities, "viewmat": torch.eye(4)}
    names |= {"scales": adapted.scales, "K": torch.eye(3), "width": 2, "height": 2, "clod_adapter": clod_adapter}
    exec(block(".hook("), names, names)
    hook = Hook(adapted.sigma_d, adapted.attenuation, 3.0, adapted.growth_d)
    want = hook(adapted.means, adapted.opacities, torch.eye(4))
    assert torch.equal(names["opacities"], want[0]) and torch.equal(names["keep"], want[1])
    assert torch.equal(names["scales"], adapted.scales * want[2][:, None]) and want[2].max() > 1.1
    monkeypatch.setattr("clod_adapter.hook.time.perf_counter", iter(0.02 * k for k in range(99)).__next__)
    names |= {"hook": hook, "a": adapted.opacities, "path": [torch.eye(4)] * 4}
    exec(block(".hold("), names, names)
    assert names["hook"].virtual_scale == pytest.approx(3.3)
    assert names["hold"].hook.virtual_scale == pytest.approx(3.63)


def test_defaults_of_the_page_match_the_reader() -> None:
    told = dict(re.findall(r"`(\w+)`\s+\(`?(?:default )?([\w./-]+)`?\)", PAGE.split("2. **Activate**")[0]))
    assert set(told) == {field.name for field in fields(AttenuationConfig)}
    for name, value in told.items():
        default = getattr(AttenuationConfig(), name)
        assert value == default if isinstance(default, str) else eval(value) == pytest.approx(default)
