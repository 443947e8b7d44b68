"""Checkpoints of gsplat's trainer, ``.pt``: the only format that is a pickle, of which only tensors
are read.

Files of this package have ``sigma_d`` and ``growth_d`` among the ``splats`` too, and the JSON
document as text under ``clod_adapter`` (``settings.document``). The trainer and its viewers read
the tensors that they know, by name.
"""

from __future__ import annotations

import io
import pickletools
import re
import warnings
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clod_adapter.errors import ClodError
from clod_adapter.io.file_formats import KEY, START, read_bytes, reject
from clod_adapter.io.settings import (
    MODEL,
    WARNING,
    Metadata,
    Source,
    document,
    of_another_method,
    parse_metadata,
)
from clod_adapter.io.values import SIGMA, arrays_of, dial_columns

if TYPE_CHECKING:
    from clod_adapter.gaussians import Gaussians

FRAME = "gsplat's trainer may have normalised the coordinates; photographs must be in the same"
# What the trainer corrects for each photograph, by the names of its modules in a checkpoint, and
# the remedy.
_CORRECTIONS = {
    "pose_adjust": (
        "cameras",
        "give the corrected cameras with the photographs, or train without --pose_opt",
    ),
    "post_processing": ("colours", "train without that, or expect a lower PSNR"),
    "app_module": ("colours", "train without --app_opt, or expect a lower PSNR"),
}
_PICKLE_LIMIT = 1 << 20  # bytes; of a few tensors it has a few hundred
_PLAIN = r"collections OrderedDict|torch\._utils _rebuild_(tensor_v2|parameter)|torch \w+Storage"


def check(path: Path) -> None:
    """Rejects, without torch, what is not a file of ``torch.save``, or would unpack to more than it
    is.
    """
    start = read_bytes(path, START)
    if start.startswith(b"\x80"):
        raise ClodError(
            f"{path}: is a pickle in PyTorch's format before 1.6; load it and torch.save it again"
        )
    if not start.startswith(b"PK"):
        reject(path, start, "is no file of torch.save; export the checkpoint as a PLY")
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        pickles = [entry for entry in entries if entry.filename.endswith("/data.pkl")]
        stored = all(entry.compress_type == zipfile.ZIP_STORED for entry in entries)
        fits = stored and sum(entry.file_size for entry in entries) <= path.stat().st_size
        if not fits or len(pickles) != 1 or pickles[0].file_size > _PICKLE_LIMIT:
            raise ValueError("it is a zip archive that torch.save does not write")
        # A pickle that names anything but what plain tensors need: ``weights_only`` runs no code
        # either, but lets a hundred bytes of it ask for gigabytes.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd escapes in it
            for opcode, argument, _ in pickletools.genops(archive.read(pickles[0])):
                named = opcode.name in ("GLOBAL", "INST", "STACK_GLOBAL")
                if named and not re.fullmatch(_PLAIN, str(argument)):
                    raise ValueError(
                        f"it holds {argument}, more than tensors, and is not unpickled"
                    )


def read(path: Path, data: bytes) -> Source:
    """Reads a checkpoint of gsplat's trainer, or one written here; with ``weights_only``, so that
    no code runs.
    """
    import torch  # here: check does without it

    from clod_adapter.integrations.splats import NAMES

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        checkpoint = torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)
    content = type(checkpoint).__name__
    splats = None
    if isinstance(checkpoint, dict):
        content = ", ".join(map(repr, list(checkpoint)[:5]))
        splats = checkpoint.get("splats")
    if not isinstance(splats, dict):
        raise ValueError(f"it has no dictionary 'splats' of gsplat's trainer, but {content}")
    names = (*NAMES, *dial_columns(splats))
    arrays = {}
    for name in names:
        arrays[NAMES.get(name, name)] = _values(name, splats, len(data))
    metadata = parse_metadata(path, checkpoint.get(KEY), dial=SIGMA in arrays)
    notes = [] if metadata.described else [FRAME]
    for name, (correction, remedy) in _CORRECTIONS.items():
        if name in checkpoint:
            notes.append(
                f"{WARNING}trained with {correction} corrected for each photograph ({name}), which"
                f" is not applied; {remedy}"
            )
    notes += of_another_method(splats)
    return Source(arrays, metadata, tuple(notes), metadata.about, not metadata.described)


def _values(name: str, splats: dict[str, Any], size: int) -> np.ndarray:
    """A parameter as float32, unless it is none or claims more values than the file's ``size`` in
    bytes.
    """
    import torch

    value = splats.get(name)
    if value is None:
        hint = "; with appearance optimisation its trainer stores no colours" * (
            "features" in splats
        )
        raise ValueError(f"splats has no {name!r}{hint}")
    usable = (
        isinstance(value, torch.Tensor)
        and value.device.type == "cpu"
        and value.layout == torch.strided
    )
    if not usable or not value.is_floating_point() or value.nbytes > size:
        raise ValueError(f"splats[{name!r}] is no plain tensor of numbers")
    return value.detach().float().numpy()


def write(path: Path, gaussians: Gaussians, metadata: Metadata) -> tuple[str, ...]:
    """Writes every value unchanged."""
    import torch

    from clod_adapter.integrations.splats import NAMES

    arrays = arrays_of(path, gaussians)
    names = NAMES | {name: name for name in dial_columns(arrays)}
    splats = {name: torch.from_numpy(arrays[ours]) for name, ours in names.items()}
    # By way of memory, as the entries of a file are named after it, and this one's name is
    # temporary.
    buffer = io.BytesIO()
    torch.save({"step": 0, "splats": splats, KEY: document(MODEL, metadata)}, buffer)
    path.write_bytes(buffer.getbuffer())
    return ()
