"""Captures and Gaussians that the tests of training share."""

import pytest

from clod_adapter import Gaussians, Scene
from clod_adapter.initialization.importance import removal_error
from scenes import capture, gaussians


@pytest.fixture(scope="module")
def captured() -> tuple[Gaussians, Scene]:
    return capture()


@pytest.fixture(scope="module")
def blob() -> Gaussians:
    return gaussians(400, 1, 0, size=0.05)


@pytest.fixture(scope="module")
def visible(captured: tuple[Gaussians, Scene]) -> tuple[Gaussians, Scene]:
    """A capture without unseen Gaussians."""
    base, scene = captured
    return base.select(removal_error(base, scene.train) > 0), scene
