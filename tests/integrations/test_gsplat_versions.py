"""The wrappers against stand-ins with the signatures of gsplat 1.4.0 to 1.6.0."""

from __future__ import annotations

import inspect
import sys
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

import gsplat_versions
from backends import fresh_copy
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from gsplat_versions import FUNCTIONS
from scenes import ring

N, WIDTH, HEIGHT = 5, 20, 12
VERSIONS = gsplat_versions.signatures()
OURS = ("sigma_d", "virtual_scale", "attenuation", "growth_d")
WHOLE = AttenuationConfig(tau=0.02, max_sv=5.0)


@pytest.fixture(params=VERSIONS)
def version(request: pytest.FixtureRequest) -> str:
    return request.param


def wrapper(monkeypatch: pytest.MonkeyPatch, version: str) -> tuple[Any, ModuleType]:
    """The stand-in for this version and our module on top of it."""
    stand_in = gsplat_versions.module(version)
    monkeypatch.setitem(sys.modules, "gsplat.cuda._torch_impl", getattr(stand_in, "torch_code", None))
    return stand_in, fresh_copy(monkeypatch, "gsplat", "gsplat", stand_in)


def arguments(function: Any, batch: tuple[int, ...], cameras: int, degree: int | None) -> dict[str, Any]:
    """Every tensor that a function takes, random, with the axes that gsplat documents for it."""
    views = ring(cameras * max(1, *batch, 1), WIDTH, HEIGHT)
    features = (N, 4, 3) if degree is not None else (N, 3)
    shapes: dict[str, tuple[int, ...]] = {
        "means": (*batch, N, 3), "quats": (*batch, N, 4), "scales": (*batch, N, 3), "opacities": (*batch, N),
        "covars": (*batch, N, 3, 3), "backgrounds": (*batch, cameras, 3), "radial_coeffs": (*batch, cameras, 6),
        "tangential_coeffs": (*batch, cameras, 2), "thin_prism_coeffs": (*batch, cameras, 4),
        "viewmats_rs": (*batch, cameras, 4, 4), "rays": (*batch, cameras, HEIGHT, WIDTH, 6),
        "colors": features if degree is not None else (*batch, cameras, *features),
        "extra_signals": (*batch, *features) if degree is None else features,
    }  # fmt: skip
    generator = torch.Generator().manual_seed(0)
    given: dict[str, Any] = {name: torch.rand(shape, generator=generator) for name, shape in shapes.items()}
    given["opacities"] = given["opacities"].clamp(min=0.1)
    given["viewmats"] = torch.stack([view.viewmat for view in views]).reshape(*batch, cameras, 4, 4)
    given["Ks"] = torch.stack([view.K for view in views]).reshape(*batch, cameras, 3, 3)
    given |= {"width": WIDTH, "height": HEIGHT, "sh_degree": degree, "extra_signals_sh_degree": degree}
    return {name: value for name, value in given.items() if name in inspect.signature(function).parameters}


def same(ours: Any, theirs: Any) -> None:
    assert type(ours) is type(theirs)
    if isinstance(theirs, tuple):
        for mine, want in zip(ours, theirs, strict=True):
            same(mine, want)
    elif isinstance(theirs, dict):
        assert list(ours) == list(theirs)
        for name in theirs:
            same(ours[name], theirs[name])
    elif isinstance(theirs, Tensor):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5)
    else:
        assert ours == theirs


def test_the_types_have_the_arguments_of_all_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    """None is missing, none is invented, and those before the keywords have one place in every version."""
    module = wrapper(monkeypatch, "1.6.0")[1]
    assert sorted(module.__all__) == sorted(FUNCTIONS)
    for name in FUNCTIONS:
        typed = inspect.signature(inspect.unwrap(getattr(module, name))).parameters
        stand_ins = [getattr(gsplat_versions.module(version), name) for version in VERSIONS]
        theirs = [list(inspect.signature(stand_in).parameters) for stand_in in stand_ins]
        assert set(typed) == {*OURS, *(each for names in theirs for each in names)}
        positional = [p.name for p in typed.values() if p.kind is p.POSITIONAL_OR_KEYWORD]
        assert all(names[: len(positional)] == positional for names in theirs)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_signature_is_the_installed_one_and_four(monkeypatch: pytest.MonkeyPatch, version: str, name: str) -> None:
    stand_in, module = wrapper(monkeypatch, version)
    theirs, ours = (inspect.signature(getattr(each, name)).parameters for each in (stand_in, module))
    rest = ["kwargs"] if "kwargs" in theirs else []
    assert list(ours) == [*(each for each in theirs if each not in rest), *OURS, *rest]
    assert all(ours[each].default == theirs[each].default for each in theirs)
    assert getattr(module, name).__name__ == name and "dial" in getattr(module, name).__doc__


@pytest.mark.parametrize("degree", [None, 1], ids=["colours", "harmonics"])
@pytest.mark.parametrize("batch", [(), (2,)], ids=["one scene", "batch"])
@pytest.mark.parametrize("name", FUNCTIONS[:2])
def test_every_argument_is_divided_among_cameras(
    monkeypatch: pytest.MonkeyPatch, version: str, name: str, batch: tuple[int, ...], degree: int | None
) -> None:
    """One call for each camera, joined, is one call for all: images and everything in meta."""
    if batch and version in ("1.4.0", "1.5.0"):
        pytest.skip("this version has no batches")
    stand_in, module = wrapper(monkeypatch, version)
    function = getattr(stand_in, name)
    given = arguments(function, batch, 3, degree)
    mode = {"render_mode": "RGB+ED"} if name == "rasterization_2dgs" else {}
    dial = {"sigma_d": torch.full_like(given["opacities"], 1e9), "attenuation": WHOLE}
    theirs = function(**given, **mode)
    same(getattr(module, name)(**given, **mode, **dial), theirs)
    if "rays" in given:  # the only argument that gsplat broadcasts
        given["rays"] = given["rays"][(0,) * len(batch)][:1]
        same(module.rasterization(**given, **dial)[0], stand_in.rasterization(**given)[0])
        same(
            module.rasterization(**given | {"colors": None}, **dial)[0],
            stand_in.rasterization(**given | {"colors": None})[0],
        )


def test_images_of_the_inria_wrappers_are_joined(monkeypatch: pytest.MonkeyPatch, version: str) -> None:
    """Images of all cameras, where gsplat returns them or refuses; further arguments are passed on."""
    stand_in, module = wrapper(monkeypatch, version)
    for name in FUNCTIONS[2:]:
        function = getattr(stand_in, name)
        given = arguments(function, (), 3, None)
        dial = {"sigma_d": torch.full_like(given["opacities"], 1e9), "attenuation": WHOLE}
        places = ("viewmats", "Ks", "backgrounds", "colors")
        single = [function(**given | {each: given[each][c : c + 1] for each in places}) for c in range(3)]
        found = getattr(module, name)(**given, **dial, packed=True)
        if name == "rasterization_inria_wrapper":
            want = torch.stack([image.reshape(HEIGHT, WIDTH, 3) for image, _, _ in single])
            same(found, (want, None, {}))
        else:
            same(found[0], (torch.cat([of[0][0] for of in single]), torch.cat([of[0][1] for of in single])))
            assert found[1]["radii"].shape == (3, N) and found[1]["means2d"].shape == (3, N, 3)
            assert found[1]["n_cameras"] == 3 and found[1]["gaussian_ids"] is None


@pytest.mark.parametrize("name", FUNCTIONS)
def test_culled_rows_are_culled_by_the_projection(monkeypatch: pytest.MonkeyPatch, version: str, name: str) -> None:
    """By their opacity where the projection has it as an argument, else by a centre behind the camera."""
    stand_in, module = wrapper(monkeypatch, version)
    passed: dict[str, Any] = {}
    function = getattr(stand_in, name)
    given = arguments(function, (), 1, None)

    def recording(*args: Any, **kwargs: Any) -> Any:
        passed.update(kwargs)

    recording.__signature__ = inspect.signature(function)  # type: ignore[attr-defined]
    monkeypatch.setattr(stand_in, name, recording)
    sigma_d = torch.tensor([1e9, 1e-6, 1e9, 1e-6, 1e9])
    getattr(module, name)(**given, sigma_d=sigma_d, virtual_scale=3.0, attenuation=WHOLE)
    culled = sigma_d < 1
    assert torch.equal(passed["opacities"] == 0, culled)
    depths = passed["means"] @ given["viewmats"][0, 2, :3] + given["viewmats"][0, 2, 3]
    torch.testing.assert_close(passed["means"][~culled], given["means"][~culled], rtol=0, atol=0)
    if name == "rasterization" and version != "1.4.0":
        assert passed["means"] is given["means"]
    else:
        torch.testing.assert_close(depths[culled], torch.full((2,), -1.0))


def test_bad_arguments_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ImportError, match="pip install gsplat==1.5.3"):
        fresh_copy(monkeypatch, "gsplat", "gsplat", None)
    stand_in, module = wrapper(monkeypatch, "1.4.0")
    given = arguments(stand_in.rasterization, (), 2, None)
    with pytest.raises(TypeError, match="unexpected keyword argument 'with_ut'"):
        module.rasterization(**given, with_ut=True, sigma_d=given["opacities"])
    given = arguments(stand_in.rasterization_inria_wrapper, (), 2, None)
    with pytest.raises(ClodError, match="masks may differ between cameras"):
        module.rasterization_inria_wrapper(**given, masks=torch.ones(2), sigma_d=given["opacities"])
