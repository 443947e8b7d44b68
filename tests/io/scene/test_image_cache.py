"""Photographs that are read on access: the same pixels, within the limit, and read no more often than needed."""

from __future__ import annotations

import pickle
import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from clod_adapter.cameras import Camera, StoredView, View
from clod_adapter.errors import ClodError
from clod_adapter.io.scene.image_cache import ImageCache
from clod_adapter.io.scene.load import load_scene

ONE = 64 * 48 * 3


def numbered(count: int, cache: ImageCache) -> tuple[list[View], list[int]]:
    """Views whose pixels are their number, and how often each was read."""
    reads = [0] * count

    def read(k: int) -> torch.Tensor:
        reads[k] += 1
        return torch.full((48, 64, 3), k, dtype=torch.uint8)

    def made(k: int) -> View:
        view = View(Camera(torch.eye(4), torch.eye(3), 64, 48, f"{k}"), torch.full((48, 64, 3), k, dtype=torch.uint8))
        return cache.store(view, lambda: read(k))

    return [made(k) for k in range(count)], reads


@pytest.mark.parametrize("room", [0, 1, 3, 10])
def test_size_stays_within_the_limit(room: int) -> None:
    cache = ImageCache(room * ONE + ONE // 2)
    views, _ = numbered(8, cache)
    for k in [*range(8), 3, 3, 0, 7, 7, 2]:
        assert int(views[k].image.unique()) == k
        assert cache.held <= cache.limit and cache.held == min(room, 8) * ONE


def test_most_recently_used_images_are_kept() -> None:
    cache = ImageCache(2 * ONE)
    views, reads = numbered(3, cache)  # 1 and 2 are kept
    for k in (1, 2, 1, 2):
        assert views[k].image is views[k].image
    assert reads == [0, 0, 0] and cache.reads == 0
    _ = views[0].image, views[2].image, views[1].image  # 0 takes the place of 1
    assert reads == [1, 1, 0] and cache.reads == 2


def test_cached_scene_equals_the_scene(capture: Any) -> None:
    whole, cache = load_scene(capture.scene), ImageCache(2 * ONE)
    stored = load_scene(capture.scene, cache=cache)
    assert stored.notes == whole.notes
    for views, others in ((whole.train, stored.train), (whole.test, stored.test)):
        for one, other in zip(views, others, strict=True):
            assert isinstance(other, StoredView) and one.camera.name == other.camera.name
            assert torch.equal(one.image, other.image)
            moved = other.at(replace(other.camera, near=0.5))
            assert isinstance(moved, StoredView) and torch.equal(moved.image, one.image) and moved.camera.near == 0.5
    assert cache.held <= 2 * ONE and cache.reads > 0


def test_photograph_that_changes_is_refused(capture: Any, tmp_path: Path) -> None:
    shutil.copytree(capture.scene, tmp_path / "scene")
    stored = load_scene(tmp_path / "scene", cache=ImageCache(0))
    for path in (tmp_path / "scene" / "images").iterdir():
        Image.new("RGB", (32, 24)).save(path)
    with pytest.raises(ClodError, match=r"view '001.png': image must be uint8 of shape \(48, 64, 3\)"):
        _ = stored.train[0].image


def test_stored_view_can_be_replaced_compared_and_pickled() -> None:
    cache = ImageCache(0)
    (view, other), reads = numbered(2, cache)
    assert view == view and view != other and len({view, other, view}) == 2 and reads == [0, 0]
    moved = replace(view, camera=replace(view.camera, near=0.5))
    assert moved.camera.near == 0.5 and torch.equal(moved.image, view.image)
    again = pickle.loads(pickle.dumps(other))
    assert type(again) is View and again.camera.name == "1" and torch.equal(again.image, other.image)


def test_concurrent_reads() -> None:
    cache = ImageCache(2 * ONE)
    views, _ = numbered(5, cache)
    with ThreadPoolExecutor(8) as pool:
        looked = list(pool.map(lambda k: int(views[k % 5].image.unique()), range(400)))
    assert looked == [k % 5 for k in range(400)] and cache.held == 2 * ONE
