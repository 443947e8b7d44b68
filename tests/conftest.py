"""Fixtures of several folders: the shared data, a browser, and a tiny capture."""

# Before anything imports torch, whose idle threads would else spin and take the cores from the
# kernels.
import clod_adapter  # noqa: F401
from clod_adapter.cameras import intrinsics

# isort: split
import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
import torch
from common import SHARED
from filelock import FileLock
from PIL import Image

import browser
import fake_gpu
from clod_adapter import Camera, Gaussians, detach, render
from clod_adapter.cli.main import main
from clod_adapter.cli.shared.console import Console
from clod_adapter.cli.shared.inputs import prepare_kernels
from clod_adapter.config import FILTERS
from clod_adapter.evaluation import frame_times
from clod_adapter.io.formats.splat_transform import VARIABLE
from clod_adapter.training import pseudo_views
from formats import inria_rows, write_rows
from models import write_model
from runs import accepted
from scenes import capture as perturbed
from scenes import looking, seeded

fake_gpu.register()
frame_times.NOISY = math.inf  # whether a note is given depends on the load
pseudo_views.MANY = 8  # the tests' captures have eight, which are few by the measure of real ones


def pytest_sessionstart(session):
    """Compiles the kernels; of several test processes the first does, and the others load them."""
    if run := getattr(session.config, "workerinput", {}).get("testrunuid"):
        torch.set_num_threads(1)  # the processes share the cores; tests of threads set their number
        with FileLock(Path(tempfile.gettempdir()) / f"clod-{run}.lock"):
            for screen_filter in (FILTERS["off"], FILTERS["on"]):
                prepare_kernels(Console(quiet=True), screen_filter=screen_filter)


@pytest.fixture
def ci_banana():
    """A small real scene of the shared data: CLOD_SHARED_DATA, or shared/data beside the
    checkout.
    """
    if not (path := SHARED / "ci_banana").exists():
        pytest.skip(f"shared data absent: {path} (set CLOD_SHARED_DATA)")
    return path


@pytest.fixture(scope="session")
def chromium():
    """The one browser of a test process (Playwright allows no second); skips where there is
    none.
    """
    with browser.launch() as chromium:
        yield chromium


@pytest.fixture
def without_splat_transform(monkeypatch):
    """Hides splat-transform, which otherwise packs every exported page and takes seconds."""
    monkeypatch.setenv(VARIABLE, "there-is-none")


@dataclass(frozen=True)
class Capture:
    """A scene folder with ten 64x48 photographs, the checkpoint they show, and a writer of such
    checkpoints.
    """

    scene: Path
    ply: Path
    gaussians: Gaussians
    write: Callable[[Path, Gaussians], Path]


@pytest.fixture(scope="session")
def capture(tmp_path_factory):
    """300 Gaussians in Inria's layout, photographed from a circle around them."""
    folder = tmp_path_factory.mktemp("capture")
    scene = folder / "scene"
    (scene / "images").mkdir(parents=True)
    normal = partial(torch.randn, generator=seeded(1))
    gaussians = Gaussians(
        means=normal(300, 3),
        quats=normal(300, 4),
        log_scales=normal(300, 3) * 0.5 - 2.0,
        opacity_logits=normal(300) * 1.5 + 1.0,
        sh0=normal(300, 1, 3),
        shN=normal(300, 3, 3) * 0.1,
    )
    cameras = [_camera(2 * math.pi * i / 10) for i in range(10)]
    names = [f"{i:03}.png" for i in range(10)]
    write_model(scene, cameras, names)
    for camera, name in zip(cameras, names, strict=True):
        Image.fromarray(render(gaussians, camera).pixels.numpy()).save(scene / "images" / name)
    return Capture(scene, _write_inria(folder / "base.ply", gaussians), gaussians, _write_inria)


@pytest.fixture(scope="module")
def captured():
    return perturbed()


@pytest.fixture(scope="session")
def attenuated(capture, tmp_path_factory):
    """The capture's checkpoint with a dial up to 4 and its quality table, as clod-adapt writes."""
    path = tmp_path_factory.mktemp("attenuated") / "dial.ply"
    words = [capture.ply, "--images", capture.scene, "--iters", 12, "--max-sv", 4, "--out", path]
    assert main(accepted([*words, "--quiet"])) == 0
    return path


def _write_inria(path, gaussians):
    return write_rows(path, inria_rows(detach(gaussians)))


def _camera(angle):
    viewmat = looking(-torch.tensor([math.sin(angle), 0.1, math.cos(angle)]))
    viewmat[:3, 3] = torch.tensor([0.0, 0.0, 5.0])
    return Camera(viewmat, intrinsics(60.0, 60, 32, 24), 64, 48)
