"""gsplat's functions with a dial: same arguments plus four, same results but ``meta`` of several
cameras.

from clod_adapter.integrations import gsplat as clod_gsplat
colors, alphas, meta = clod_gsplat.rasterization(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height,
    sigma_d=model.sigma_d, growth_d=model.growth_d, attenuation=model.attenuation, virtual_scale=3,
)

gsplat takes one opacity and scale per Gaussian for all cameras; the dial gives one for each camera.
So each camera is one call of gsplat; the images are stacked as gsplat's, and ``meta`` is a list of
each camera's. Culled Gaussians cost no more than Gaussians out of view. Nothing is gathered: rows
and ids stay those of the caller.

For gsplat 1.4.0 to 1.6.0: the signatures are those of the installed version, and the four.
"""

import functools
import inspect
from collections.abc import Callable
from inspect import Parameter
from typing import Any, TypeVar

from torch import Tensor

from clod_adapter.hook import dropped_in
from clod_adapter.integrations.gsplat_cameras import PER_ROW, render

try:
    import gsplat
except ImportError as error:
    raise ImportError(
        "gsplat cannot be imported; it needs torch and CUDA: pip install gsplat==1.5.3"
    ) from error

__all__ = [
    "rasterization",
    "rasterization_2dgs",
    "rasterization_2dgs_inria_wrapper",
    "rasterization_inria_wrapper",
]

DIAL_ARGUMENTS = {"sigma_d": None, "virtual_scale": 1.0, "attenuation": None, "growth_d": None}
Meta = dict[str, Any] | list[dict[str, Any]]  # one for each of several cameras
Documented = TypeVar("Documented", bound=Callable[..., Any])


def _of_gsplat(documented: Documented) -> Documented:
    """gsplat's function of the same name with the four arguments; of ``documented`` only name,
    types and docstring are used.
    """
    name = documented.__name__
    projection = inspect.signature(gsplat.fully_fused_projection).parameters
    # whether culled Gaussians must be moved out of view: a projection that takes opacities leaves
    # out those of 0 itself
    hide = not (name == "rasterization" and "opacities" in projection)

    @functools.wraps(documented)
    def attenuated(*args: Any, **kwargs: Any) -> Any:
        function = getattr(gsplat, name)
        dial = {key: kwargs.pop(key, default) for key, default in DIAL_ARGUMENTS.items()}
        settings = dropped_in(**dial)
        if settings is None:
            return function(*args, **kwargs)
        bound = inspect.signature(function).bind(*args, **kwargs)
        bound.apply_defaults()
        arguments = bound.arguments | bound.arguments.pop("kwargs", {})
        arguments |= {key: dial[key] for key in PER_ROW}
        return render(function, arguments, dial["virtual_scale"], settings, hide)

    parameters = [*inspect.signature(getattr(gsplat, name)).parameters.values()]
    for key, default in DIAL_ARGUMENTS.items():
        parameters.append(Parameter(key, Parameter.KEYWORD_ONLY, default=default))
    parameters.sort(key=lambda parameter: parameter.kind)
    attenuated.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return attenuated  # type: ignore[return-value]


@_of_gsplat
def rasterization(*args: Any, **kwargs: Any) -> tuple[Tensor, Tensor, Meta]:
    """``gsplat.rasterization`` with the opacities and scales of one dial value, for each camera.

    Equals gsplat called with the opacities of ``attenuation.attenuate`` and ``scales`` times its
    growth (``covars``, where given, times its square), camera by camera for ``[C, 4, 4]``.
    Differentiable in ``sigma_d``, ``growth_d`` and all that gsplat differentiates in; the distances
    are constants, so the dial adds nothing to the gradients of ``means`` and ``viewmats``. ``meta``
    of one camera is gsplat's, as densification strategies need it. ``meta`` of several is a list of
    each camera's, in the order of the images: to densify with several, call once per camera.

    Pass a file's ``Gaussians.screen_filter`` as without a dial: ``eps2d`` is its variance, and
    ``rasterize_mode="antialiased"`` its compensation of opacities.

    Distances are from the centre of ``viewmats`` for every camera model: Gaussians fade as an
    orthographic camera moves back; for a rolling shutter it is the first pose. The paper's form
    takes the frustum of a pinhole camera with these ``Ks``.

    Args:
        sigma_d: ``[N]`` like ``opacities``; None calls gsplat's function unchanged, with a
            warning if ``virtual_scale`` is above 1.
        virtual_scale: the dial s >= 0.
        attenuation: settings of the equation, ``Gaussians.attenuation`` of the file; by default
            ``AttenuationConfig()``, with distances in world units.
        growth_d: ``[..., N]`` exponents of the growth of the scales, which begins at
            ``reference_distance`` of the attenuation, which is needed then, or, where that is 0, at
            1 world unit; None for no growth.

    The others are those of the installed gsplat, by position or by name, with its defaults.

    Returns:
        ``render_colors [C, H, W, X]``, ``render_alphas [C, H, W, 1]`` and ``meta``, for several
        cameras a list.

    Raises:
        ClodError: the dial is negative, growth_d comes without attenuation, a tensor holds
            integers, sigma_d or growth_d differs from opacities in shape, ``distributed`` is set,
            with which the cameras of all processes share one opacity, several scenes are given in
            batch dimensions, or several cameras come with a tensor that none of the known versions
            has.
        TypeError: an argument is missing, or the installed gsplat does not have it.
    """
    raise NotImplementedError


@_of_gsplat
def rasterization_2dgs(
    *args: Any, **kwargs: Any
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor, Tensor, Meta]:
    """``gsplat.rasterization_2dgs`` with the opacities and scales of one dial value; see
    ``rasterization``.

    The gradients for densification are in ``meta["gradient_2dgs"]``, as with gsplat.

    Returns:
        Colours, alphas, normals, normals from depth (None without a depth), distortion and median
        depth of ``[C, H, W, X]``, and ``meta``.
    """
    raise NotImplementedError


@_of_gsplat
def rasterization_inria_wrapper(*args: Any, **kwargs: Any) -> tuple[Tensor, None, Meta]:
    """``gsplat.rasterization_inria_wrapper`` with a dial; see ``rasterization``.

    gsplat 1.5 and 1.6 return one camera's image without the camera's dimension, and reject several;
    several are returned as ``[C, H, W, X]`` here, as gsplat 1.4.0 returns them.
    """
    raise NotImplementedError


@_of_gsplat
def rasterization_2dgs_inria_wrapper(
    *args: Any, **kwargs: Any
) -> tuple[tuple[Tensor, Tensor], Meta]:
    """``gsplat.rasterization_2dgs_inria_wrapper`` with a dial; see ``rasterization``.

    For several cameras gsplat returns the alphas and the maps of the last one; here they are of
    all.
    """
    raise NotImplementedError
