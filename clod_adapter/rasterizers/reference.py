"""The reference for tests: plain torch splatting, every Gaussian at every pixel, gradients by
autograd.

Any device, any float type, slow. Same conventions as the fast backends: pixel centres at +0.5, the
screen-space filter, the camera's near plane, alpha clamped to 0.999 and dropped below 1/255, a
pixel ends with the Gaussian at which its transmittance falls to 1e-4.
"""

import torch
from torch import Tensor

from clod_adapter.cameras import Camera
from clod_adapter.config import CLASSIC, ScreenFilter
from clod_adapter.gaussians import SH_C0
from clod_adapter.rasterizers.protocol import ALPHA_MAX, ALPHA_MIN, T_MIN, drawable


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh0: Tensor,
    shN: Tensor,
    camera: Camera,
    background: Tensor,
    screen_filter: ScreenFilter = CLASSIC,
) -> tuple[Tensor, Tensor]:
    """See ``clod_adapter.rasterizers.Splat``."""
    viewmat = camera.viewmat.to(means)
    K = camera.K.to(means)
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    visible = (points[:, 2] >= camera.near) & drawable(quats, opacities)
    rows = visible.nonzero()[:, 0]
    rows = rows[points[rows, 2].argsort(stable=True)]
    centres, projected = project(points[rows], quats[rows], scales[rows], viewmat, K, camera)
    covariance, opacities = blurred(projected, opacities[rows], screen_filter)
    colors = shade(means[rows], sh0[rows], shN[rows], camera.position.to(means))
    x = torch.arange(camera.width).to(means) + 0.5
    y = torch.arange(camera.height).to(means) + 0.5
    grid = torch.meshgrid(x, y, indexing="xy")
    pixels = torch.stack(grid, -1).reshape(-1, 1, 2)
    offsets = pixels - centres
    power = -0.5 * torch.einsum("pni,nij,pnj->pn", offsets, torch.linalg.inv(covariance), offsets)
    alphas = (opacities * power.exp()).clamp(max=ALPHA_MAX)
    weights, transmittance = blend(torch.where(alphas >= ALPHA_MIN, alphas, 0))
    image = weights @ colors + transmittance[:, None] * background
    size = camera.height, camera.width
    return image.reshape(*size, 3), (1 - transmittance).reshape(size)


def project(
    points: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmat: Tensor,
    K: Tensor,
    camera: Camera,
) -> tuple[Tensor, Tensor]:
    """Image centres ``[n, 2]`` and P ``[n, 2, 3]`` of covariances P P^T by the local affine
    approximation (EWA).
    """
    depth = points[:, 2]
    focal = torch.stack([K[0, 0], K[1, 1]])
    size = torch.tensor([camera.width, camera.height]).to(points)
    margin = 0.15 * size / focal
    low = -K[:2, 2] / focal - margin
    high = (size - K[:2, 2]) / focal + margin
    ray = torch.maximum(points[:, :2] / depth[:, None], low).minimum(high)
    jacobian = torch.zeros(len(points), 2, 3).to(points)
    jacobian[:, 0, 0] = focal[0] / depth
    jacobian[:, 1, 1] = focal[1] / depth
    jacobian[:, :, 2] = -focal * ray / depth[:, None]
    half = jacobian @ viewmat[:3, :3] @ rotations(quats) * scales[:, None, :]
    centres = focal * points[:, :2] / depth[:, None] + K[:2, 2]
    return centres, half


def rotations(quats: Tensor) -> Tensor:
    """``[n, 3, 3]`` the matrices of quaternions wxyz of any length above 0."""
    unit_quats = quats / quats.norm(dim=1, keepdim=True)
    w = unit_quats[:, :1, None]
    identity = torch.eye(3).to(quats)
    # multiplies by the axis: axis x v
    cross = torch.linalg.cross(unit_quats[:, 1:, None], identity[None], dim=1)
    return identity + 2 * (w * cross + cross @ cross)


def blurred(half: Tensor, opacities: Tensor, screen_filter: ScreenFilter) -> tuple[Tensor, Tensor]:
    """Covariances ``[n, 2, 2]`` with the filter's variance, and the opacities ``[n]`` that go with
    them.

    A compensated opacity below ALPHA_MIN is 0. ``det P P^T`` is taken as the squared length of the
    cross product of the rows of P ``[n, 2, 3]``, exact where P P^T would cancel.
    """
    covariance = half @ half.transpose(1, 2) + screen_filter.variance * torch.eye(2).to(half)
    if not screen_filter.compensate:
        return covariance, opacities
    normal = torch.linalg.cross(half[:, 0], half[:, 1])
    unblurred = normal.square().sum(1)
    ratio = unblurred / torch.linalg.det(covariance)
    has_area = ratio > 0  # the derivative of the square root at 0 is infinite
    compensated = opacities * ratio.where(has_area, 1).sqrt().where(has_area, 0)
    return covariance, compensated.where(compensated >= ALPHA_MIN, 0)


def blend(alphas: Tensor) -> tuple[Tensor, Tensor]:
    """Front-to-back weights ``[pixels, n]`` and the remaining transmittance ``[pixels]``."""
    through = torch.cumprod(1 - alphas, 1)
    first = torch.ones_like(through[:, :1])
    before = torch.cat([first, through[:, :-1]], 1)
    alive = before > T_MIN
    weights = torch.where(alive, alphas * before, 0)
    return weights, torch.where(alive, 1 - alphas, 1).prod(1)


def shade(means: Tensor, sh0: Tensor, shN: Tensor, eye: Tensor) -> Tensor:
    """Colours ``max(0, 0.5 + SH(direction))``, ``[n, 3]``."""
    offsets = means - eye
    directions = offsets / offsets.norm(dim=1, keepdim=True)
    coefficients = torch.cat([sh0, shN], 1)
    basis = sh_basis(directions)[:, : coefficients.shape[1], None]
    return (0.5 + (basis * coefficients).sum(1)).clamp(min=0)


def sh_basis(directions: Tensor) -> Tensor:
    """The 16 real spherical harmonics up to degree 3 of unit ``directions [n, 3]``, order and signs
    of 3DGS.
    """
    x, y, z = directions.unbind(1)
    xx = x * x
    yy = y * y
    zz = z * z
    xy = x * y
    yz = y * z
    xz = x * z
    return torch.stack(
        [
            torch.full_like(x, SH_C0),
            -0.4886025119029199 * y,
            0.4886025119029199 * z,
            -0.4886025119029199 * x,
            1.0925484305920792 * xy,
            -1.0925484305920792 * yz,
            0.31539156525252005 * (2 * zz - xx - yy),
            -1.0925484305920792 * xz,
            0.5462742152960396 * (xx - yy),
            -0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * xy * z,
            -0.4570457994644658 * y * (4 * zz - xx - yy),
            0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
            -0.4570457994644658 * x * (4 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3 * yy),
        ],
        1,
    )
