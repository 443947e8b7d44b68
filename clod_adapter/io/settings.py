"""Settings that travel with a file: one reader for PLY comments, PLY columns and JSON documents.

Each format gives the same mapping, whose numbers may be text: ``attenuation`` and ``screen_filter``
to the fields of their classes, ``calibration`` as QualityTable.as_dict, ``origin`` to [x, y, z],
``about`` to lines of text, and ``package_version``.

Formats other than PLY store it as a JSON document under the key ``clod_adapter``
(``file_formats.KEY``). An unknown field is ignored with a note, a damaged setting is rejected, and
a damaged quality table, which rendering does not need, is ignored with a note.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from clod_adapter._support.text import package_version
from clod_adapter.config import CLASSIC, FILTERS, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError, rejected_if_damaged
from clod_adapter.origin import NOWHERE, Origin, parse_origin
from clod_adapter.quality_table import QualityTable

if TYPE_CHECKING:
    import numpy as np

WARNING = "warning: "  # prefix of a note that must not be missed
FILTER = "screen_filter"
MODEL = "clod-model"
ADAPTER = "clod-adapter"
# Kinds of documents: the version of the format, and the message for another kind.
KINDS = {
    MODEL: (1, "is not a model but {}; clod-adapt apply makes one of an adapter"),
    ADAPTER: (
        3,
        "is not an adapter but {}; give what clod-adapt wrote beside its PLY; a 'clod-model' needs"
        " none",
    ),
}
# what is wrong and what to do, for ``rejected_if_damaged``
DAMAGED = "its settings are damaged", "restore them, or export the file again"
# Settings of a dial before every Gaussian had a reach.
EARLIER = {"tau", "eps", "cut", "normalizer"}
EARLIER_FORM = (
    "its dial is of an earlier form, which is not read any more; adapt its checkpoint again with"
    " clod-adapt"
)


@dataclass(frozen=True)
class Metadata:
    """The settings of a file, as read or to be written."""

    attenuation: AttenuationConfig | None = None  # None for a file without a sigma_d
    screen_filter: ScreenFilter | None = None  # None where the file does not store one
    # as stored; ``matching_quality_table`` compares it with the Gaussians
    quality_table: QualityTable | None = None
    origin: Origin = NOWHERE  # what the means are relative to, world units
    about: tuple[str, ...] = ()  # lines on the history of the file
    # of the package that made it; "" as read: another program, to be written: the running one
    version: str = ""
    described: bool = False  # whether the file has a description by this package
    notes: tuple[str, ...] = ()  # what was ignored, one line each


class Source(NamedTuple):
    """The content of a file, as every reader returns it; ``checkpoint.load`` makes a checkpoint of
    it.

    ``arrays`` are every row of the file, by the names of ``Gaussians.tensors``, in any type of
    floats; of a PLY also "masks" ``[N, 2]`` (MaskGaussian's) and "filter_3D" ``[N, 1]``
    (Mip-Splatting's), where it has them.
    """

    arrays: dict[str, np.ndarray]
    metadata: Metadata  # means are relative to its origin
    # what the reader noticed, one line each, besides the notes of the metadata
    notes: tuple[str, ...] = ()
    comments: tuple[str, ...] = ()  # lines on its history, and settings in a PLY's comments
    activation_unknown: bool = False  # whether opacities and scales may be activated already
    # ``[N]`` structured array of a PLY as it is in the file, native byte order
    rows: np.ndarray | None = None
    head: Any = None  # ``ply.Head`` of a PLY
    sha256: str = ""  # of the bytes that were parsed, hex


def read_metadata(
    path: Path, values: Mapping[str, Any], *, dial: bool, described: bool = True
) -> Metadata:
    """The settings in a mapping; of a file that has a sigma_d (``dial``) missing ones take their
    defaults.
    """
    notes: list[str] = []
    with rejected_if_damaged(path, *DAMAGED):
        return Metadata(
            attenuation=(
                _attenuation(path, values.get("attenuation", {}), described, notes)
                if dial
                else None
            ),
            screen_filter=_screen_filter(values[FILTER], notes) if FILTER in values else None,
            quality_table=_quality_table(values.get("calibration"), notes),
            origin=parse_origin(values.get("origin", NOWHERE)),
            about=tuple(map(str, values.get("about", ()))),
            version=str(values.get("package_version", "")),
            described=described,
            notes=tuple(notes),
        )


def _attenuation(
    path: Path, stored: Mapping[str, Any], described: bool, notes: list[str]
) -> AttenuationConfig:
    if EARLIER & stored.keys():
        raise ClodError(f"{path}: {EARLIER_FORM}")
    kinds: dict[str, Any] = {field.name: type(field.default) for field in fields(AttenuationConfig)}
    values = {name: kind(stored[name]) for name, kind in kinds.items() if name in stored}
    _note_unknown(stored, kinds, notes)
    missing = [name for name in kinds if name not in stored]
    if missing and described:
        notes.append(f"settings that are missing have their defaults: {', '.join(missing)}")
    return AttenuationConfig(**values)


def _screen_filter(stored: Any, notes: list[str]) -> ScreenFilter:
    compensate = {"True": True, "False": False}.get(stored["compensate"], stored["compensate"])
    _note_unknown(stored, ("variance", "compensate"), notes)
    return ScreenFilter(variance=float(stored["variance"]), compensate=compensate)


def _quality_table(stored: Any, notes: list[str]) -> QualityTable | None:
    try:
        return None if stored is None else QualityTable.from_dict(stored)
    except (ClodError, AttributeError, KeyError, OverflowError, TypeError, ValueError) as error:
        notes.append(f"the quality table is unusable and ignored ({error!s:.80})")
        return None


def _note_unknown(stored: Mapping[str, Any], known_names: Any, notes: list[str]) -> None:
    if unknown := [name for name in stored if name not in known_names]:
        notes.append(f"settings unknown to this version ignored: {', '.join(map(repr, unknown))}")


# What other methods store beside plain Gaussians, by names of a PLY's properties or of gsplat's
# tensors.
_METHODS = {
    r"trbf_\w+|motion_\w+|omega_\d+|f_t_\d+": "SpacetimeGaussians, which move and fade with time",
    r"t|times|t_scale|scale_t(_\d+)?|rot_r_\d+|durations?|velocit\w+": (
        "a 4D method, whose Gaussians move and fade with time"
    ),
    r"sg_\w+|\w*asg_\w+": "spherical Gaussians, lobes that are added to the colour",
    r"sb_params\w*|betas?": (
        "Beta Splatting, which has another falloff, and lobes that are added to the colour"
    ),
    r"shapes?|nu_degree|negative": "a method whose Gaussians have another falloff",
    r"(rough|metal|specular|albedo|base_color|diffuse|brdf|incidents|refl)\w*": (
        "a method that lights materials"
    ),
}


def of_another_method(names: Iterable[str]) -> list[str]:
    """A warning for each method whose renderer draws more of a file with these names than plain
    Gaussians.
    """
    lines = []
    for pattern, method in _METHODS.items():
        extra = [name for name in names if re.fullmatch(pattern, name)]
        if extra:
            examples = ", ".join(extra[:3]) + ", ..." * (len(extra) > 3)
            lines.append(
                f"{WARNING}{examples} of {method}, are not drawn, so the picture is not the trained"
                " one; adapt a checkpoint of plain Gaussians"
            )
    return lines


def matching_quality_table(metadata: Metadata, count: int) -> tuple[QualityTable | None, list[str]]:
    """The quality table if it was measured on ``count`` Gaussians; else None and a note."""
    stored = metadata.quality_table
    if stored is None or stored.total == count:
        return stored, []
    return None, [
        f"the quality table is of {stored.total} Gaussians and ignored, these are {count}"
    ]


def document(kind: str, metadata: Metadata, **further: Any) -> str:
    """JSON that ``parse_document`` and ``read_metadata`` invert, without what is not set.

    Its keys are sorted, so that equal models give equal files.
    """
    values: dict[str, Any] = {
        "format": kind,
        "format_version": KINDS[kind][0],
        "package_version": metadata.version or package_version(),
    }
    if metadata.attenuation:
        values["attenuation"] = asdict(metadata.attenuation)
    if metadata.screen_filter not in (None, CLASSIC):
        values[FILTER] = asdict(metadata.screen_filter)
    if any(metadata.origin):
        values["origin"] = list(metadata.origin)
    if metadata.quality_table:
        values["calibration"] = metadata.quality_table.as_dict()
    if metadata.about:
        values["about"] = list(metadata.about)
    return json.dumps(values | further, sort_keys=True, allow_nan=False)


def parse_metadata(
    path: Path, text: str | bytes | dict[str, Any] | None, *, dial: bool
) -> Metadata:
    """The settings in a model's document, parsed or not; those of a file of another program where
    it is None.
    """
    values = {} if text is None else parse_document(path, text, MODEL)
    return read_metadata(path, values, dial=dial, described=text is not None)


def parse_document(path: Path, text: str | bytes | dict[str, Any], kind: str) -> dict[str, Any]:
    """A document of this kind; rejects another kind, and a newer version."""
    version, wrong = KINDS[kind]
    with rejected_if_damaged(path, *DAMAGED):
        values: dict[str, Any] = text if isinstance(text, dict) else json.loads(text)
        stored = values["format"]
        newer = stored == kind and values["format_version"] > version
    if stored != kind:
        raise ClodError(f"{path}: {wrong.format(f'{stored!r:.40}')}")
    if newer:
        raise ClodError(
            f"{path}: its format {values['format_version']!r:.20} is too new; upgrade clod-adapter"
        )
    return values


# The screen-space filter as other programs state it: Brush and splat-transform write the comment
# TAG, Postshot ``antialiased 1``, SPZ a flag, Mip-Splatting the column ``filter_3D``. None of them
# states the variance.
TAG = "SplatRenderMode: mip"
_ANTIALIASED = r"(?i)\s*(splatrendermode:\s*mip|antialiased 1)\s*"
_EITHER = r"(?i)\s*(splatrendermode:\s*\S*|antialiased [01])\s*"


def is_antialiased(comments: Iterable[str]) -> bool:
    """Whether a comment of another program states that opacities are compensated."""
    return any(re.fullmatch(_ANTIALIASED, comment) for comment in comments)


def tagged(comments: Sequence[str], screen_filter: ScreenFilter) -> list[str]:
    """The comments, with those of other programs corrected where they contradict
    ``screen_filter``.
    """
    if is_antialiased(comments) == screen_filter.compensate:
        return list(comments)
    consistent = [comment for comment in comments if not re.fullmatch(_EITHER, comment)]
    return [*consistent, TAG] if screen_filter.compensate else consistent


def stated_filter(source: Source) -> ScreenFilter:
    """The screen-space filter that a file states, or that other programs' comments and columns
    imply.
    """
    metadata = source.metadata
    compensated = is_antialiased(source.comments)
    if metadata.screen_filter is not None:
        return metadata.screen_filter
    if "sigma_d" in source.arrays or (metadata.described and source.head is None):
        return CLASSIC
    if "filter_3D" in source.arrays or (compensated and "Exported from Brush" in source.comments):
        return FILTERS["mip"]
    return FILTERS["on" if compensated else "off"]
