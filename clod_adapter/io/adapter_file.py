"""Adapters as safetensors files: tensors, and one JSON document.

Tensors: ``sigma_d`` float32, with growth also ``growth_d`` float32, and each update under the name
of its attribute: float16 for a difference from the base, float32 for new values. Far Gaussians'
attributes have names that begin with ``far.``. The JSON is stored under the metadata key
``clod_adapter``, keys sorted: equal adapters give equal files.
"""

from pathlib import Path

from clod_adapter.adapter import Adapter, dial_tensors
from clod_adapter.config import CLASSIC
from clod_adapter.errors import ClodError, rejected_if_damaged
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.file_formats import KEY, START, read_bytes, reject_known
from clod_adapter.io.settings import (
    ADAPTER,
    Metadata,
    document,
    parse_document,
    read_metadata,
)
from clod_adapter.io.tensor_file import read_tensors, write_tensors

ADDED = "far."


def save_adapter(path: str | Path, adapter: Adapter) -> None:
    """Writes an adapter; loading it gives the same tensors and settings, bit for bit.

    Raises:
        ClodError: its config is not plain JSON, or the file cannot be written.
    """
    tensors = {**dial_tensors(adapter), **adapter.updates}
    tensors |= {ADDED + name: tensor for name, tensor in adapter.added.items()}
    settings = Metadata(
        adapter.attenuation,
        adapter.screen_filter,
        adapter.quality_table,
        adapter.origin,
        version=adapter.version,
    )
    try:
        text = document(
            ADAPTER, settings, base_sha256=adapter.base_fingerprint, config=adapter.config
        )
    except (TypeError, ValueError) as error:
        raise ClodError(
            f"the adapter's config is not plain JSON ({error}); use finite numbers and strings"
        ) from error
    with atomic_path(path) as temporary:
        write_tensors(temporary, tensors, {KEY: text})
        load_adapter(temporary)  # it can be read again


def load_adapter(path: str | Path) -> Adapter:
    """Reads an adapter.

    Raises:
        ClodError: the file cannot be read, is damaged, not an adapter, or of a newer format.
    """
    path = Path(path)
    reject_known(path, read_bytes(path, START))
    with rejected_if_damaged(path, "is no adapter, or its tensors or settings are damaged"):
        tensors, metadata = read_tensors(path)
        if KEY not in metadata:
            raise ClodError(
                f"{path}: is a safetensors file but not an adapter; give a file that this package"
                " wrote"
            )
        about = parse_document(path, metadata[KEY], ADAPTER)
        for name, kind in (("base_sha256", str), ("config", dict)):
            if not isinstance(about[name], kind):
                raise TypeError(f"{name} is {about[name]!r:.40}, not a {kind.__name__}")
        settings = read_metadata(path, about, dial=True)
        assert settings.attenuation is not None
        names = [name for name in tensors if name.startswith(ADDED)]
        added = {name.removeprefix(ADDED): tensors.pop(name) for name in names}
        return Adapter(
            added=added,
            sigma_d=tensors.pop("sigma_d"),
            growth_d=tensors.pop("growth_d", None),
            attenuation=settings.attenuation,
            updates=tensors,
            base_fingerprint=about["base_sha256"],
            config=about["config"],
            version=settings.version,
            quality_table=settings.quality_table,
            origin=settings.origin,
            screen_filter=settings.screen_filter or CLASSIC,
            notes=settings.notes,
        )
