"""Adapters as safetensors files: tensors, and one JSON document that says what they are.

Tensors: ``sigma_d`` float32, and under its attribute's name each update, whose type tells what it is:
float16 a difference from the base, float32 the new values. The JSON stands under the metadata key
``clod_adapter``; being one key it is written in one order, so equal adapters give equal files.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from safetensors.torch import save

from clod_adapter.adapter import Adapter
from clod_adapter.calibration import Calibration
from clod_adapter.config import AttenuationConfig
from clod_adapter.errors import ClodError
from clod_adapter.io.atomic import atomic_path
from clod_adapter.io.card import FORMAT as MODEL
from clod_adapter.io.origin import NOWHERE, parse_origin
from clod_adapter.io.tensor_file import load_tensors

KEY = "clod_adapter"
FORMAT = "clod-adapter"
FORMAT_VERSION = 1


def save_adapter(path: str | Path, adapter: Adapter) -> None:
    """Writes an adapter; loading it gives the same tensors and settings, bit for bit.

    Raises:
        ClodError: its config is not plain JSON, or the file cannot be written.
    """
    about = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "package_version": adapter.version,
        "base_sha256": adapter.base_fingerprint,
        "attenuation": asdict(adapter.attenuation),
        "config": adapter.config,
    }
    if any(adapter.origin):
        about["origin"] = adapter.origin
    if adapter.calibration is not None:
        about["calibration"] = adapter.calibration.as_dict()
    check_config(adapter.config)
    metadata = {KEY: json.dumps(about, sort_keys=True, allow_nan=False)}
    tensors = {"sigma_d": adapter.sigma_d, **adapter.updates}
    with atomic_path(path) as temporary:
        # Not save_file, which makes files that only their owner can read.
        temporary.write_bytes(save({name: tensor.cpu().contiguous() for name, tensor in tensors.items()}, metadata))


def check_config(config: dict[str, Any]) -> None:
    """Raises the ClodError of a config that ``save_adapter`` would refuse; to be called before time is spent on it."""
    try:
        json.dumps(config, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ClodError(f"the adapter's config is not plain JSON ({error}); use finite numbers and strings") from error


def load_adapter(path: str | Path) -> Adapter:
    """Reads an adapter.

    Raises:
        ClodError: the file cannot be read, is damaged, no adapter, or of a newer format.
    """
    tensors, metadata = load_tensors(Path(path))
    if KEY not in metadata:
        raise ClodError(f"{path}: is a safetensors file but no clod-adapter; give a file that this package wrote")
    try:
        about = json.loads(metadata[KEY])
        if about["format"] == MODEL:
            raise ClodError("is a whole model and no adapter; it needs no base, give it in the model's place")
        if about["format"] != FORMAT:
            raise ClodError(f"is not a clod-adapter file but {about['format']!r}; give a file that this package wrote")
        if about["format_version"] > FORMAT_VERSION:
            raise ClodError(f"its format {about['format_version']} is too new for this version; upgrade clod-adapter")
        for name in ("base_sha256", "package_version"):
            if not isinstance(about[name], str):
                raise TypeError(f"{name} is {about[name]!r}, not a string")
        if not isinstance(about["config"], dict):
            raise TypeError(f"config is {about['config']!r:.40}, not an object")
        return Adapter(
            sigma_d=tensors.pop("sigma_d"),
            attenuation=AttenuationConfig(**about["attenuation"]),
            updates=tensors,
            base_fingerprint=about["base_sha256"],
            config=about["config"],
            version=about["package_version"],
            calibration=Calibration.from_dict(about["calibration"]) if "calibration" in about else None,
            origin=parse_origin(about.get("origin", NOWHERE)),
        )
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise ClodError(f"{path}: its description is damaged ({error!r}); copy or export the adapter again") from error
    except ClodError as error:
        raise ClodError(f"{path}: {error}") from error
