"""What would draw or store something else than was meant is refused or warned of, in one line."""

import warnings
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch

import clod_adapter as clod
import gsplat_versions
import inria_forks
from backends import fresh_copy
from scenes import camera, gaussians, scene

N, VIEW, WORLD = 20, camera(24, 18), clod.AttenuationConfig()
MODEL = clod.with_dial(gaussians(N, 1, 0), torch.ones(N), WORLD, torch.ones(N))
HOOK, WHOLE = clod.Hook(MODEL.sigma_d, WORLD, 2.0, MODEL.growth_d), torch.ones(N, dtype=torch.int64)
Drawing = Callable[..., Any]


@pytest.fixture
def draws(monkeypatch: pytest.MonkeyPatch) -> dict[str, Drawing]:
    """The drop-ins for gsplat and for Inria's rasterizer, and the renderer, called with arguments of the dial alone."""
    given = {**scene(N, 1, 0), "opacities": MODEL.opacities}
    colors, points = torch.cat([given.pop("sh0"), given.pop("shN")], 1), given["means"]
    ours = fresh_copy(monkeypatch, "gsplat", "gsplat", gsplat_versions.module("1.5.3")).rasterization
    fork = inria_forks.module("inria 2024")
    of_inria = fresh_copy(monkeypatch, "inria", "diff_gaussian_rasterization", fork).GaussianRasterizer(
        inria_forks.settings_of(fork.GaussianRasterizationSettings, VIEW)
    )
    views = {"viewmats": VIEW.viewmat[None], "Ks": VIEW.K[None], "width": VIEW.width, "height": VIEW.height}
    rows = {"shs": colors, "scales": given["scales"], "rotations": given["quats"]}
    return {
        "gsplat": lambda **dial: ours(**{**given, "colors": colors, "sh_degree": 1} | views | dial),
        "inria": lambda **dial: of_inria(
            **{"means3D": points, "means2D": 0 * points, "opacities": given["opacities"][:, None], **rows} | dial
        ),
        "render": lambda **dial: clod.render(gaussians(N, 1, 0), VIEW, **dial),
    }


@pytest.mark.parametrize("name", ["gsplat", "inria", "render"])
def test_a_dial_value_without_a_dial_is_warned_of(draws: dict[str, Drawing], name: str) -> None:
    with pytest.warns(
        UserWarning, match="virtual_scale is 3, but there is no sigma_d: all .* drawn as they are"
    ) as told:
        draws[name](virtual_scale=3)
    assert name == "inria" or told[0].filename == __file__  # torch calls Inria's
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draws[name]()


@pytest.mark.parametrize("name", ["gsplat", "inria"])
@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"growth_d": MODEL.growth_d, "sigma_d": MODEL.sigma_d}, "growth_d needs sigma_d and attenuation"),
        ({"growth_d": MODEL.growth_d, "attenuation": WORLD}, "growth_d needs sigma_d and attenuation"),
        ({"virtual_scale": -1}, "virtual_scale is -1, it must be at least 0"),
        ({"sigma_d": MODEL.sigma_d, "opacities": WHOLE}, "opacities is torch.int64, it must be floating point"),
        ({"sigma_d": WHOLE}, "sigma_d is torch.int64, it must be floating point"),
    ],
)
def test_drop_ins_refuse(draws: dict[str, Drawing], name: str, given: dict[str, Any], message: str) -> None:
    with pytest.raises(clod.ClodError, match=message):
        draws[name](**given)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: MODEL.replace(means=MODEL.means.long()), "Gaussians.means is torch.int64, it must be floating point"),
        (lambda: MODEL.replace(opacity_logits=WHOLE), "Gaussians.opacity_logits is torch.int64"),
        (lambda: HOOK(MODEL.means, WHOLE, VIEW.viewmat), "opacities is torch.int64"),
        (lambda: HOOK(MODEL.means.long().numpy(), MODEL.opacities.numpy(), VIEW.viewmat), "means is torch.int64"),
        *((partial(clod.save, name, MODEL), f"{name}: {message}") for name, message in (
            ("x.foo", ".foo is no format to write; choose one of .ply, .glb, "), ("x", "no suffix is no format"),
            ("x.ksplat", ".ksplat is no format"), ("x.sog", "is written by clod-adapt export alone: save a .ply"),
        )),
    ],
)  # fmt: skip
def test_calls_are_refused(
    call: Callable[[], Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(clod.ClodError, match=message):
        call()
    assert not list(tmp_path.iterdir())
