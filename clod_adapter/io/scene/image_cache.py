"""Photographs that are read on access; the most recently used stay in memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable

from torch import Tensor

from clod_adapter.cameras import StoredView, View


class ImageCache:
    """Pixels of photographs, least recently used dropped first, of at most ``limit`` bytes in total.

    A single photograph larger than ``limit`` is not kept.

    Attributes:
        limit: bytes; held: bytes in memory now.
        reads: how often a photograph was read again.
    """

    def __init__(self, limit: int) -> None:
        self.limit, self.held, self.reads = limit, 0, 0
        self._images: OrderedDict[int, Tensor] = OrderedDict()
        self._lock, self._count = threading.Lock(), 0

    def store(self, view: View, read: Callable[[], Tensor]) -> View:
        """The view without its pixels, which are kept while there is room and else come from ``read``."""
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
