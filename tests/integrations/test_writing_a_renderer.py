"""The code and the defaults in docs/writing_a_renderer.md, and its two examples."""

import re
import runpy
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import clod_adapter
import gsplat_in_torch
from clod_adapter.config import AttenuationConfig
from clod_adapter.equation.attenuation import attenuate
from clod_adapter.equation.growth import growth_factors
from clod_adapter.hook import Hook

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "writing_a_renderer.md").read_text(encoding="utf-8")
DIALS = (1, 2, 3, 5)


def my_opacity(opacity: float, sigma: float, d: float, scale: float, eps: float, tau: float, soft: bool) -> float:
    """The package's opacity, in float32."""
    config = AttenuationConfig(eps=eps, tau=tau, cut="soft" if soft else "hard", max_sv=1)
    return float(attenuate(*torch.tensor([[opacity], [sigma], [d]]), scale, config, activated=True).drawn)


def my_scale(growth: float, distance: float, scale: float, reach: float) -> float:
    """The package's factor of the scales, in float32."""
    return float(growth_factors(*torch.tensor([[growth], [distance]]), scale, reach))


@pytest.fixture
def adapted(capture: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> clod_adapter.Gaussians:
    """Gaussians with a dial, saved as adapted.ply in the test's folder."""
    monkeypatch.chdir(tmp_path)
    sigma_d, growth_d = torch.rand(2, len(capture.gaussians), generator=torch.Generator().manual_seed(0))
    attenuation = AttenuationConfig(tau=0.02, cut="soft", reference_distance=5.0)
    gaussians = capture.gaussians.replace(sigma_d=2.5 + 15 * sigma_d, growth_d=growth_d, attenuation=attenuation)
    clod_adapter.save("adapted.ply", gaussians)
    return gaussians


def block(word: str) -> str:
    """The page's Python block that contains a word."""
    (found,) = (text for text in re.findall(r"```python\n(.*?)```", PAGE, re.S) if word in text)
    return str(found)


def test_the_code_of_the_page_runs(adapted: clod_adapter.Gaussians, monkeypatch: pytest.MonkeyPatch) -> None:
    """The golden loop, which refuses functions that are off; the hook; and a held frame time, with 20 ms a frame."""
    own = {"my_opacity": my_opacity, "my_scale": my_scale}
    exec(block("golden"), dict(own))
    for name, function in own.items():
        with pytest.raises(AssertionError):
            exec(block("golden"), own | {name: lambda *row, function=function: function(*row) * 1.001})
    names: dict[str, Any] = {"means": adapted.means, "opacities": adapted.opacities, "viewmat": torch.eye(4)}
    names |= {"scales": adapted.scales, "K": torch.eye(3), "width": 2, "height": 2, "clod_adapter": clod_adapter}
    Path("adapted.ply").rename("model.ply")
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


def test_the_hook_example(adapted: clod_adapter.Gaussians, capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(ROOT / "examples" / "04_hook.py"))["main"]("adapted.ply")
    counts = [int(row.split(": ")[1].split()[0]) for row in capsys.readouterr().out.splitlines()]
    assert counts == sorted(counts, reverse=True) and counts[0] > counts[-1] > 0
    pictures = [np.asarray(Image.open(f"adapted_dots_sv{dial}.png")) for dial in DIALS]
    assert all(picture.shape == (240, 320, 3) and picture.any() for picture in pictures)
    assert len({picture.tobytes() for picture in pictures}) == 4


def test_the_gsplat_example(
    adapted: clod_adapter.Gaussians, capture: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The example's images match the package's."""
    pytest.importorskip("gsplat", reason="pip install gsplat==1.5.3")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cpu":
        gsplat_in_torch.install(monkeypatch)
    main = runpy.run_path(str(ROOT / "examples" / "03_gsplat.py"))["main"]
    main("adapted.ply", str(capture.scene), device)
    assert capsys.readouterr().out.count("of 300 Gaussians a camera") == 4
    camera = clod_adapter.load_scene(capture.scene).test[0].camera
    for dial in DIALS:
        own = clod_adapter.render(adapted, camera, dial).pixels.numpy().astype(float)
        assert np.abs(np.asarray(Image.open(f"adapted_gsplat_sv{dial}.png")) - own).mean() < 0.1
