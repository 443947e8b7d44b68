"""Stand-ins for several versions of gsplat, with their signatures; what they return depends on every argument.

An image is a number for each camera times a pattern, so images of all cameras in one call and one call for each camera
agree only if every argument with a camera axis is divided along it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

TEXT = Path(__file__).parent / "integrations" / "gsplat_signatures.txt"
FUNCTIONS = ("rasterization", "rasterization_2dgs", "rasterization_inria_wrapper", "rasterization_2dgs_inria_wrapper")
TILE = 16

# Dimensions of each tensor without cameras and batches, from gsplat's docstrings; colours with an SH degree have 3.
OF_SCENE = {"means": 2, "quats": 2, "scales": 2, "opacities": 1, "covars": 3}
OF_CAMERA = {
    "viewmats": 2, "Ks": 2, "backgrounds": 1, "viewmats_rs": 2, "radial_coeffs": 1, "tangential_coeffs": 1,
    "thin_prism_coeffs": 1, "rays": 3,
}  # fmt: skip
OF_EITHER = {"colors": "sh_degree", "extra_signals": "extra_signals_sh_degree"}


def signatures() -> dict[str, dict[str, str]]:
    """``{version: {function: parameters}}`` as written in the text, without line breaks."""
    parts = re.split(r"^\[(.+)\]$", TEXT.read_text(), flags=re.M)[1:]
    found = {
        version: dict(re.findall(r"^(\w+)\((.*)\)$", text.replace("\n    ", " "), re.M))
        for version, text in zip(parts[::2], parts[1::2], strict=True)
    }
    common = found.pop("every version")
    return {version: common | own for version, own in found.items()}


def module(version: str, draw: Callable[[str, str, dict[str, Any]], Any] | None = None) -> Any:
    """The module ``gsplat`` of this version; ``draw`` gets a function's name, the version and the arguments."""
    made: Any = ModuleType("gsplat")
    made.__version__ = version
    for name, parameters in signatures()[version].items():
        space: dict[str, Any] = {"_draw": draw or _draw, "_version": version}
        declared = re.sub(r"=(\w+\.\w+)", r"='\1'", parameters)
        exec(f"def {name}({declared}):\n    return _draw({name!r}, _version, locals())", space)
        setattr(made, name, space[name])
    if version == "1.6.0":
        made.torch_code = ModuleType("gsplat.cuda._torch_impl")
        made.torch_code._bits_for_count = bits_for_count
    return made


def bits_for_count(count: int) -> int:
    """gsplat 1.6's width of a tile's number; earlier versions use ``int.bit_length``."""
    return (count - 1).bit_length()


def _draw(name: str, version: str, given: dict[str, Any]) -> Any:
    """The results of a version's function."""
    batch = given["means"].shape[:-2]
    shape = (*batch, given["viewmats"].shape[-3])
    assert version not in ("1.4.0", "1.5.0") or not batch
    value = torch.ones(shape)
    for number, (argument, tensor) in enumerate(sorted(given.items())):
        if isinstance(tensor, Tensor):
            value = value + (1 + number) * _per_image(argument, tensor, given, shape)
    pattern = torch.arange(given["height"] * given["width"] * 3.0).reshape(given["height"], given["width"], 3)
    image = value[..., None, None, None] * pattern
    if name == "rasterization":
        return image, image[..., :1], _meta(version, given, shape, value)
    if name == "rasterization_2dgs":
        surface = image.squeeze(0) if given["render_mode"] in ("RGB+D", "RGB+ED") else None
        extra = {"render_distort": image[..., :1], "gradient_2dgs": torch.zeros(*shape, 1, 2, requires_grad=True)}
        meta = _meta(version, given, shape, value) | extra
        return image, image[..., :1], image, surface, image[..., :1], image[..., :1], meta
    if name == "rasterization_inria_wrapper":
        return image if version == "1.4.0" else image.reshape(*batch, *pattern.shape), None, {}
    meta = {"radii": value[..., None].expand(*shape, 5), "normals_rend": image[-1:], "means2d": torch.zeros(5, 3)}
    return (image, image[-1:, ..., :1]), meta | {"n_cameras": shape[-1], "gaussian_ids": None}


def _per_image(name: str, tensor: Tensor, given: dict[str, Any], shape: tuple[int, ...]) -> Tensor:
    """``shape`` numbers, each from the part of an argument that belongs to an image."""
    own = OF_SCENE.get(name) or OF_CAMERA.get(name) or (2 if given[OF_EITHER[name]] is None else 3)
    leading = tensor.shape[: tensor.dim() - own]
    weights = torch.linspace(0.5, 1.5, tensor[(0,) * len(leading)].numel()).reshape(tensor.shape[len(leading) :])
    numbers = (tensor * weights).flatten(len(leading)).mean(-1)
    if name in OF_CAMERA or len(leading) == len(shape):
        assert name == "rays" or leading == shape
        return numbers.expand(shape)
    assert name in OF_EITHER or leading == shape[:-1]
    return numbers[..., None].expand(shape) if leading else numbers.expand(shape)


def _meta(version: str, given: dict[str, Any], shape: tuple[int, ...], value: Tensor) -> dict[str, Any]:
    """One row and one pair for each image."""
    across, down = -(-given["width"] // TILE), -(-given["height"] // TILE)
    bits = (bits_for_count if version == "1.6.0" else int.bit_length)(across * down)
    meta = {
        "camera_ids": None, "gaussian_ids": None, "radii": value[..., None], "depths": value[..., None],
        "means2d": value[..., None, None].expand(*shape, 1, 2).clone().requires_grad_(), "n_cameras": shape[-1],
        "tile_width": across, "tile_height": down, "isect_ids": torch.arange(value.numel()) << 32 + bits,
        "isect_offsets": torch.arange(value.numel()).reshape(*shape, 1, 1).expand(*shape, down, across),
    }  # fmt: skip
    if isinstance(signals := given.get("extra_signals"), Tensor):
        meta["render_extra_signals"] = value[..., None, None, None].expand(*shape, 4, 4, signals.shape[-1])
    return meta
