"""Cameras for a checkpoint without photographs, placed from its Gaussians alone.

Three properties tell where photographs looked. Gaussians are a pixel or two large in their nearest
cameras, so the smallest give the distance of the cameras (``reach``). Only photographs change the
higher SH degrees from 0, so their colour is strong in the directions from which a Gaussian was
photographed. And photographers stand within what they photograph: behind a camera outside a
building, or below the ground, there is nothing.

Candidate cameras look at random Gaussians from random directions. Each is scored by three small
renderings (``_score``), and as many again are tried near the best. Of the good ones, cameras far
from each other are chosen. No up direction, scene type or unit is needed.
"""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from clod_adapter.adapter import detach
from clod_adapter.cameras import Camera, intrinsics, looking, near_plane
from clod_adapter.config import require
from clod_adapter.errors import ClodError
from clod_adapter.gaussians import SH_C0, Gaussians, nonfinite_rows
from clod_adapter.initialization.importance import coverage
from clod_adapter.progress import Listener, Phase, tell
from clod_adapter.render import splat

ROUND_CAMERAS = 96  # cameras of a round
MOST_CAMERAS = 384  # cameras of all rounds
SHOWN = 0.99  # share of the Gaussians to show
COVERED = 0.5  # pixels with which a Gaussian is shown
WIDTH = 496  # of the images; sizes in pixels refer to it
HEIGHT = 368
FIELD = 55.0  # horizontal, degrees: between a phone's 65 and the 35 of a portrait lens
TRIES = 3  # candidates for each view, first anywhere, then as many near the best of those
BEST = 0.2  # share of the first candidates that are good; later ones must score as high
# standard deviation of the offset from a good camera, of the reach, and of its unit direction
STEP = 0.2
LOOK = (80, 60)  # size of the renderings that a candidate is scored by
SMALL = 0.1  # share of the Gaussians that are small
SMALL_PIXELS = 2.0  # largest size of these in the nearest cameras
NEARER = 0.15  # of the reach: nearer, on average, no camera looks at the scene
FAR = 4.0  # cameras stand at most this many times as far away as the scene is large
VISIBLE = 0.05  # Gaussians of lower opacity are ignored
SAMPLE = 200_000  # Gaussians that are rendered, about
ROUNDS = 30  # of the search for the probabilities, whose sum is then SAMPLE to a thousandth


@torch.inference_mode(False)
@torch.enable_grad()
def place_cameras(
    gaussians: Gaussians,
    *,
    views: int | None = None,
    seed: int = 0,
    field: float = FIELD,
    progress: Listener | None = None,
) -> list[Camera]:
    """Places cameras about where the scene was photographed from.

    Args:
        gaussians: a checkpoint; a dial it has is ignored.
        views: number of cameras, at least 1; by default as many as the scene needs: rounds of
            ROUND_CAMERAS cameras, each towards Gaussians that none has shown yet, until SHOWN of
            them are shown, by opacity, or there are MOST_CAMERAS.
        seed: of the candidate cameras.
        field: horizontal field of view, degrees; ideally that of the original cameras.
        progress: called in ``Phase.CAMERAS`` after each candidate.

    Returns:
        ``views`` cameras (fewer if fewer see anything) of 496x368 pixels; every prefix of a round
        is spread out.

    Raises:
        ClodError: no Gaussian is visible and finite, or no camera sees anything.
        Stopped: ``progress`` returned False.

    Example:
        >>> base = clod.load("base.ply")
        >>> cameras = clod.place_cameras(base.gaussians, views=8)
        >>> image = clod.render(base.gaussians, cameras[0]).image
    """
    require(views is None or views >= 1, "views", views, "at least 1")
    placement = _Placement(detach(gaussians), seed, field, progress)
    cameras = placement.round(views or ROUND_CAMERAS)
    while (
        views is None
        and len(cameras) + ROUND_CAMERAS <= MOST_CAMERAS
        and placement.covered_share(cameras[-ROUND_CAMERAS:]) < SHOWN
    ):
        try:
            cameras += placement.round(ROUND_CAMERAS)
        except ClodError:  # what is left cannot be shown
            break
    zoom = float(cameras[0].K[0, 0]) / cameras[0].width
    K = _intrinsics(zoom, WIDTH, HEIGHT)
    return [
        replace(camera, K=K, width=WIDTH, height=HEIGHT, name=f"placed_{k:03}")
        for k, camera in enumerate(cameras)
    ]


class _Placement:
    """Rounds of cameras for one checkpoint, each for what the cameras before do not show."""

    def __init__(
        self,
        plain: Gaussians,
        seed: int,
        field: float,
        progress: Listener | None,
    ) -> None:
        usable = _usable(plain)
        self.sample, self.growth = _sample(plain, usable, seed)
        self.zoom = 0.5 / math.tan(math.radians(field) / 2)  # the focal length in image widths
        # The distance, world units, at which the smallest tenth is at most SMALL_PIXELS pixels
        # large.
        sizes = plain.scales.amax(1)[usable]
        means = plain.means[usable]
        footprint = _quantile(sizes, SMALL) * WIDTH * self.zoom / SMALL_PIXELS
        from_centre = (means - means.median(0).values).norm(dim=1)
        self.reach = min(footprint, FAR * _quantile(from_centre, 0.5)) or footprint
        self.generator = torch.Generator().manual_seed(seed)
        self.progress = progress
        self.judged = 0  # candidates so far
        # Each row stands for growth^2 of the checkpoint's.
        self.weight = self.sample.opacities * self.growth**2
        self.hidden = torch.ones_like(self.weight)

    def round(self, views: int) -> list[Camera]:
        """Cameras that look at rows not shown yet; raises ClodError if none sees anything."""
        tries = TRIES * views
        start = self.judged
        scored: list[tuple[float, Camera]] = []

        def ranked(cameras: Iterable[Camera]) -> list[tuple[float, Camera]]:
            for camera in cameras:
                score = _score(self.sample, self.growth, camera, self.reach)
                scored.append((score, camera))
                tell(self.progress, Phase.CAMERAS, start + len(scored), start + 2 * tries)
            usable = [candidate for candidate in scored if candidate[0] > -math.inf]
            return sorted(usable, key=lambda candidate: -candidate[0])

        good = ranked(self._towards(tries))[: max(round(BEST * tries), 1)]
        if not good:
            raise ClodError(
                "no camera can be placed: the checkpoint is empty from every candidate camera"
            )
        least = good[-1][0]
        candidates = ranked(self._beside([camera for _, camera in good], tries))
        self.judged += len(scored)
        enough = max(views, sum(value >= least for value, _ in candidates))
        return self._spread([camera for _, camera in candidates[:enough]], views)

    def _towards(self, count: int) -> Iterator[Camera]:
        """Cameras towards rows, preferably small opaque ones, from uniform directions, at half to
        twice the reach.
        """
        means = self.sample.means
        # torch.multinomial has a limit of 2^24 weights.
        interest = self.weight * self.hidden / self.sample.scales.amax(1).clamp(min=1e-12)
        ends = interest.double().cumsum(0).cpu()  # cameras are placed on the CPU
        random = torch.rand(count, generator=self.generator, dtype=torch.float64)
        rows = torch.searchsorted(ends, random * ends[-1])
        targets = means[rows.clamp(max=len(means) - 1).to(means.device)].cpu()
        sides = torch.randn(count, 3, generator=self.generator, dtype=torch.float32)
        sides = F.normalize(sides, dim=1)
        random = torch.rand(count, 1, generator=self.generator, dtype=torch.float32)
        away = self.reach * 2 ** (2 * random - 1)
        for eye, target in zip(targets + away * sides, targets, strict=True):
            yield _looking(eye, target, self.zoom)

    def _beside(self, cameras: list[Camera], count: int) -> Iterator[Camera]:
        """Cameras with random offsets of position and direction from these, each in turn."""
        steps = STEP * torch.randn(count, 2, 3, generator=self.generator, dtype=torch.float32)
        for camera, (turn, step) in zip(itertools.cycle(cameras), steps, strict=False):
            eye = camera.position + self.reach * step
            forward = camera.viewmat[2, :3] + turn
            yield _looking(eye, eye + self.reach * forward, self.zoom)

    def _spread(self, cameras: list[Camera], count: int) -> list[Camera]:
        """``count`` of the cameras by farthest-point sampling of position and direction, from the
        first one.
        """
        positions = torch.stack([camera.position for camera in cameras])
        directions = torch.stack([camera.viewmat[2, :3] for camera in cameras])
        places = torch.cat([positions / self.reach, directions], 1)
        chosen: list[Camera] = []
        gap = torch.full((len(cameras),), torch.inf)
        while len(chosen) < min(count, len(cameras)):
            k = int(gap.argmax())
            chosen.append(cameras[k])
            gap = gap.minimum((places - places[k]).norm(dim=1))
        return chosen

    def covered_share(self, cameras: Sequence[Camera]) -> float:
        """The share of the Gaussians, by opacity, that these cameras and those before show: COVERED
        pixels or more.
        """
        for camera in cameras:
            pixels = coverage(self.sample, self.sample.opacities, camera, self.growth)
            self.hidden *= pixels * (WIDTH / camera.width) ** 2 < COVERED
        hidden = (self.weight * self.hidden).sum()
        return 1 - float(hidden / self.weight.sum())


def _usable(gaussians: Gaussians) -> Tensor:
    """``[n]`` int64, the visible and finite Gaussians. An infinite opacity logit is a fully opaque
    Gaussian.
    """
    others = gaussians.replace(opacity_logits=gaussians.opacities).tensors().values()
    rows = (gaussians.opacities > VISIBLE) & ~nonfinite_rows(*others)
    if not rows.any():
        raise ClodError(
            "no camera can be placed: the checkpoint has no Gaussian that is visible and finite"
        )
    return rows.nonzero()[:, 0]


def _looking(eye: Tensor, target: Tensor, zoom: float) -> Camera:
    """A camera for scoring. The up direction is unknown; COLMAP's y axis usually points down."""
    forward = F.normalize(target - eye, dim=0)
    axis = [0.0, 1.0, 0.0]
    if abs(float(forward[1])) >= 0.99:
        axis = [0.0, 0.0, 1.0]
    down = torch.tensor(axis, dtype=torch.float32)
    near = near_plane(float((target - eye).norm()))
    return Camera(looking(eye, forward, down), _intrinsics(zoom, *LOOK), *LOOK, near=near)


def _intrinsics(zoom: float, width: int, height: int) -> Tensor:
    return intrinsics(zoom * width, zoom * width, width / 2, height / 2)


def _quantile(values: Tensor, share: float) -> float:
    return float(values.kthvalue(max(round(share * len(values)), 1)).values)


def _sample(gaussians: Gaussians, rows: Tensor, seed: int) -> tuple[Gaussians, Tensor]:
    """About SAMPLE of the Gaussians at ``rows [n]``, and the factors of their scales; all, and
    ones, if n <= SAMPLE.

    One of largest scale l is drawn with probability ``p = min(1, c l)``, the sum of which is
    SAMPLE. Its scales are multiplied by ``p^-1/2``, so that surfaces are covered as before and
    walls stay opaque.
    """
    if len(rows) <= SAMPLE:
        return gaussians.select(rows).without_empty_bands(), torch.ones_like(
            gaussians.means[rows, 0]
        )
    # infinite ones are not drawn
    size = gaussians.scales.amax(1)[rows].double().nan_to_num(0.0, 0.0)
    share = size * (SAMPLE / size.sum())
    for _ in range(ROUNDS):
        share = (share * (SAMPLE / share.sum())).clamp_(max=1)
    generator = torch.Generator().manual_seed(seed)
    random = torch.rand(len(rows), generator=generator, dtype=torch.float64)
    selected = random.to(share.device) < share
    growth = share[selected].rsqrt().to(gaussians.means)
    return gaussians.select(rows[selected]).without_empty_bands(), growth


def _score(gaussians: Gaussians, growth: Tensor, camera: Camera, reach: float) -> float:
    """The likelihood that a photograph was taken from here, ``log h - 0.5 p - 2 e - 1.5 b``; -inf
    if the rendering is empty, or the mean log distance that of less than NEARER of the reach.

    h is the mean magnitude of the higher SH degrees' colour, p the mean log size in pixels without
    ``growth`` (both weighted by alpha), e the share of pixels that are not covered, b that of the
    opposite view.
    """
    depths = camera.depths(gaussians.means).clamp(min=1e-6)
    pixels = gaussians.scales.amax(1) * WIDTH / camera.width * camera.K[0, 0] / depths
    # three, as colours are; the last is not read
    values = torch.stack([pixels, depths / reach, depths], 1)
    shades = values.clamp(1e-3, 1e4).log() + 7  # positive, as colours are
    sh0 = (shades[:, None] - 0.5) / SH_C0
    plain = gaussians.replace(sh0=sh0, shN=gaussians.shN[:, :0])
    shaded, alpha = splat(plain, gaussians.opacities, camera, growth=growth)
    covered = float(alpha.sum())
    if covered < 0.1 * alpha.numel():
        return -math.inf
    size, distance, _ = (shaded.sum((0, 1)) / covered - 7).tolist()
    if distance < math.log(NEARER):
        return -math.inf
    _, alpha_behind = splat(plain, gaussians.opacities, _opposite(camera), growth=growth)
    strength = 1.0
    if gaussians.sh_degree:
        # the colour is then 0.5 + that of the higher degrees
        higher = gaussians.replace(sh0=torch.zeros_like(gaussians.sh0))
        bands, _ = splat(higher, gaussians.opacities, camera, growth=growth)
        magnitudes = (bands - 0.5 * alpha[..., None]).abs().mean(2)
        strength = float(magnitudes.sum()) / covered
    emptiness = 2 * _empty(alpha) + 1.5 * _empty(alpha_behind)
    return math.log(strength + 1e-4) - 0.5 * size - emptiness


def _opposite(camera: Camera) -> Camera:
    """A camera at the same place that looks backwards, at a quarter of the horizon."""
    turn = torch.diag(camera.viewmat.new_tensor([-1.0, 1.0, -1.0, 1.0]))
    return replace(camera, viewmat=turn @ camera.viewmat, K=_intrinsics(0.5, *LOOK))


def _empty(alpha: Tensor) -> float:
    """The share of the pixels that are not covered."""
    return float((alpha < 0.9).float().mean())
