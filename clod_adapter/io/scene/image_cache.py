"""Photographs that are read when they are looked at, of which only the latest stay in memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable

from torch import Tensor

from clod_adapter.cameras import StoredView, View


class ImageCache:
    """Pixels of photographs: those looked at last, of at most ``limit`` bytes together.

    The one in use may be larger than that by itself, and is then not kept.

    Attributes:
        limit: bytes; held: bytes that are kept now.
        reads: how often a photograph was read again.
    """

    def __init__(self, limit: int) -> None:
        self.limit, self.held, self.reads = limit, 0, 0
        self._images: OrderedDict[int, Tensor] = OrderedDict()
        self._lock, self._count = threading.Lock(), 0

    def store(self, view: View, read: Callable[[], Tensor]) -> View:
        """The view without its pixels, which ``read`` gives again; they are kept for as long as there is room."""
        with self._lock:
            key, self._count = self._count, self._count + 1
        self._keep(key, view.image)
        return StoredView(view.camera, lambda: self._look(key, read))

    def _look(self, key: int, read: Callable[[], Tensor]) -> Tensor:
        with self._lock:
            if (image := self._images.get(key)) is not None:
                self._images.move_to_end(key)
                return image
            self.reads += 1
        image = read()
        self._keep(key, image)
        return image

    def _keep(self, key: int, image: Tensor) -> None:
        with self._lock:
            if key not in self._images and image.nbytes <= self.limit:
                self._images[key] = image
                self.held += image.nbytes
            while self.held > self.limit:
                self.held -= self._images.popitem(last=False)[1].nbytes
