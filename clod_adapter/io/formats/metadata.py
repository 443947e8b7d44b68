"""The JSON document that formats other than PLY store under the key ``clod_adapter``: the settings of the dial."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import History
from clod_adapter.io.settings import DAMAGE, Metadata, damaged, document, read_metadata, stored_values

if TYPE_CHECKING:
    from clod_adapter.gaussians import Gaussians

KEY = "clod_adapter"
FORMAT, FORMAT_VERSION = "clod-model", 1


def write_metadata(gaussians: Gaussians, history: History) -> dict[str, Any]:
    """Plain JSON that ``parse_metadata`` inverts."""
    values = stored_values(gaussians.attenuation, gaussians.screen_filter, history.origin, history.calibration)
    return document(FORMAT, FORMAT_VERSION) | values | ({"about": list(history.about)} if history.about else {})


def metadata_text(values: dict[str, Any]) -> str:
    """The document with sorted keys, so that equal models give equal files."""
    return json.dumps(values, sort_keys=True, allow_nan=False)


def parse_metadata(path: Path, text: str | bytes | dict[str, Any] | None, *, dial: bool) -> Metadata:
    """The settings in a document, parsed or not; those of a file of another program where it is None.

    Args:
        dial: whether the file has sigma_d.

    Raises:
        ClodError: the document is damaged, of another kind, or of a newer format.
    """
    if text is None:
        return read_metadata(path, {}, dial=dial, described=False)
    try:
        values = text if isinstance(text, dict) else json.loads(text)
        kind, version = values["format"], values["format_version"]
        newer = version > FORMAT_VERSION
        values["package_version"]  # noqa: B018  always there
    except DAMAGE as error:
        raise damaged(path, error) from error
    if kind != FORMAT:
        raise ClodError(f"{path}: is not a model but {kind!r:.40}; clod-adapt apply makes one of an adapter")
    if newer:
        raise ClodError(f"{path}: its format {version!r:.20} is too new for this version; upgrade clod-adapter")
    return read_metadata(path, values, dial=dial)
