"""Random scenes, cameras and captures that the tests share."""

import math
import re
from functools import partial

import torch
from scipy.spatial.transform import Rotation

from clod_adapter import AttenuationConfig, Camera, Gaussians, Scene, View, render
from clod_adapter.cameras import intrinsics
from clod_adapter.integrations.splats import to_gsplat


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def camera(
    width=61,
    height=45,
    *,
    fov=60.0,
    off_centre=(0.52, 0.47),
):
    """At (0.3, -0.2, -3), looking roughly along +z, principal point at ``off_centre`` shares of the
    image.
    """
    rotation = torch.from_numpy(Rotation.from_euler("yx", [0.12, -0.07]).as_matrix()).float()
    viewmat = torch.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ torch.tensor([0.3, -0.2, -3.0])
    focal = 0.5 * width / math.tan(math.radians(fov) / 2)
    K = intrinsics(focal, focal * 1.03, width * off_centre[0], height * off_centre[1])
    return Camera(viewmat, K, width, height)


def in_front(view, points):
    """World positions of camera-space ``points [n, 3]``."""
    return view.position + points @ view.viewmat[:3, :3]


def scene(n, degree, seed, *, size=0.08):
    """Activated float32 parameters of n Gaussians in front of, beside and behind the camera."""
    normal = partial(torch.randn, generator=seeded(seed))
    return {
        "means": normal(n, 3) * torch.tensor([1.5, 1.2, 1.5]),
        "quats": normal(n, 4),
        "scales": (normal(n, 3) * 0.6 + math.log(size)).exp(),
        "opacities": (normal(n) * 2.5).sigmoid(),
        "sh0": normal(n, 1, 3) * 0.8,
        "shN": normal(n, (degree + 1) ** 2 - 1, 3) * 0.2,
    }


def gaussians(n, degree, seed, *, size=0.08):
    """The same Gaussians as a checkpoint stores them."""
    s = scene(n, degree, seed, size=size)
    logs = s["scales"].log()
    logits = s["opacities"].logit()
    return Gaussians(s["means"], s["quats"], logs, logits, s["sh0"], s["shN"])


def splatfacto_parameters(g):
    """Tensors of the Gaussians with the names and shapes of splatfacto's ``gauss_params``."""
    named = to_gsplat(g)
    named |= {"features_dc": named.pop("sh0")[:, 0], "features_rest": named.pop("shN")}
    return named | {"opacities": named["opacities"][:, None]}


def attenuated(n, degree, seed, **settings):
    """Gaussians with a sigma_d log-normal around e, and 0 in every 50th row."""
    sigma_d = (torch.randn(n, generator=seeded(seed + 1)) + 1).exp()
    sigma_d[::50] = 0.0
    attenuation = AttenuationConfig(**{"scene_distance": 3.0} | settings)
    return gaussians(n, degree, seed).replace(sigma_d=sigma_d, attenuation=attenuation)


def looking(towards):
    """``[4, 4]`` world to camera of a camera at the origin, y down."""
    forward = towards / towards.norm()
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0]), forward)
    right = right / right.norm()
    viewmat = torch.eye(4)
    viewmat[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    return viewmat


def ring(count, width, height, *, radius=4.0):
    """Cameras on a circle around the origin, looking at it, at slightly different heights and
    distances.
    """
    cameras = []
    for k in range(count):
        turn = 2 * math.pi * k / count
        eye = torch.tensor([math.cos(turn), 0.2 * math.sin(2 * turn), math.sin(turn)])
        eye = radius * (1 + 0.1 * math.cos(3 * turn)) * eye
        viewmat = looking(-eye)
        viewmat[:3, 3] = -viewmat[:3, :3] @ eye
        K = intrinsics(1.1 * width, 1.1 * width, width / 2, height / 2)
        cameras.append(Camera(viewmat, K, width, height, f"view_{k}.png"))
    return cameras


@torch.no_grad()
def photograph(truth, cameras):
    return tuple(View(each, render(truth, each).pixels) for each in cameras)


def capture(n=300, views=8, width=48, height=36, seed=0):
    """A slightly perturbed checkpoint and photographs of the original; every fourth one is held
    out.
    """
    truth = gaussians(n, 1, seed, size=0.15)
    g = seeded(seed + 1)

    def near(values, by):
        return values + by * torch.randn(values.shape, generator=g)

    base = truth.replace(
        means=near(truth.means, 0.01),
        log_scales=near(truth.log_scales, 0.05),
        sh0=near(truth.sh0, 0.05),
        opacity_logits=near(truth.opacity_logits, 0.2),
    )
    seen = photograph(truth, ring(views, width, height))
    return base, Scene(tuple(v for k, v in enumerate(seen) if k % 4), seen[::4])


def assert_equal(a, b):
    """Asserts that both have the same bits and the same attenuation settings."""
    assert a.tensors().keys() == b.tensors().keys() and a.attenuation == b.attenuation
    for name, value in a.tensors().items():
        assert torch.equal(value, b.tensors()[name]), name


def stripped(data):
    """A file without its quality table's times, which are not reproducible."""
    if data.startswith(b"ply"):
        return re.sub(rb"(?m)^(comment clod_adapter calibrated .*) \S+$", rb"\1", data)
    text = re.sub(rb'\\"frame_ms\\": [0-9.e-]+', b"", data[8:])
    return text.replace(b" ", b"")  # the header is padded with spaces to a whole number of words
