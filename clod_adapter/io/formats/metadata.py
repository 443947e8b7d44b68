"""What files other than PLY say about the Gaussians in them: one JSON document, the same in every format.

It stands under the key ``clod_adapter`` wherever a format keeps text: what sigma_d means, the origin, the calibration,
and lines on how the file came about.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from clod_adapter.calibration import Calibration
from clod_adapter.config import CLASSIC, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.io.screen_filter import entry_of, parse_entry
from clod_adapter.io.settings import as_before
from clod_adapter.origin import NOWHERE, Origin, parse_origin
from clod_adapter.version import package_version

if TYPE_CHECKING:
    from clod_adapter.gaussians import Gaussians

KEY = "clod_adapter"
FORMAT = "clod-model"
FORMAT_VERSION = 1
_LONGEST = 1 << 16  # letters of a description's lines; a PLY's header has to have room for them


@dataclass(frozen=True)
class Metadata:
    """What a file says about its Gaussians.

    Attributes:
        attenuation: how sigma_d is to be read; None where the file has none.
        calibration: of these Gaussians, if the file says so.
        origin: what the means are relative to, world units.
        about: lines on how they came about.
        version: of the package that wrote the file; "" where another program did.
        screen_filter: that they were trained with, as far as the file says.
    """

    attenuation: AttenuationConfig | None = None
    calibration: Calibration | None = None
    origin: Origin = NOWHERE
    about: tuple[str, ...] = ()
    version: str = ""
    screen_filter: ScreenFilter = CLASSIC


class Model(NamedTuple):
    """What a file holds: its Gaussians as they are in it, what it says about them, and notes on both."""

    gaussians: Gaussians
    card: Metadata
    notes: tuple[str, ...] = ()


def write_metadata(
    gaussians: Gaussians, about: Sequence[str] = (), origin: Origin = NOWHERE, calibration: Calibration | None = None
) -> dict[str, Any]:
    """Plain JSON; ``read_card`` gives it back. The arguments are those of ``writers.write``."""
    values: dict[str, Any] = {"format": FORMAT, "format_version": FORMAT_VERSION, "package_version": package_version()}
    if gaussians.attenuation is not None:
        values["attenuation"] = asdict(gaussians.attenuation)
    values |= entry_of(gaussians.screen_filter)
    if any(origin):
        values["origin"] = list(origin)
    if calibration is not None:
        values["calibration"] = calibration.as_dict()
    if about:
        values["about"] = list(about)
    return values


def metadata_text(values: dict[str, Any]) -> str:
    """The document in one order, so that equal models give equal files."""
    return json.dumps(values, sort_keys=True, allow_nan=False)


def read_card(path: Path, text: str | bytes | dict[str, Any] | None, total: int) -> tuple[Metadata, list[str]]:
    """The document of a file, parsed or not, and notes; an empty card where there is none.

    A calibration that is damaged, or of another number of Gaussians than ``total``, is left out with a note.

    Raises:
        ClodError: it is damaged, of another kind, or of a newer format.
    """
    if text is None:
        return Metadata(), []
    try:
        values = text if isinstance(text, dict) else json.loads(text)
        if values["format"] != FORMAT:
            raise ClodError(f"is no model but {values['format']!r:.40}; clod-adapt apply makes one of an adapter")
        if values["format_version"] > FORMAT_VERSION:
            raise ClodError(
                f"its format {values['format_version']!r:.20} is too new for this version; upgrade clod-adapter"
            )
        about, version = tuple(map(str, values.get("about", ()))), str(values["package_version"])
        if sum(map(len, about)) + len(version) > _LONGEST:
            raise ClodError(f"its description has more than {_LONGEST:,} letters; export the file again")
        calibration, notes = _calibration(values, total)
        return Metadata(
            attenuation=_attenuation(values["attenuation"], notes) if "attenuation" in values else None,
            calibration=calibration,
            origin=parse_origin(values.get("origin", NOWHERE)),
            about=about,
            version=version,
            screen_filter=parse_entry(values),
        ), notes
    except ClodError as error:
        raise ClodError(f"{path}: {error}") from error
    except (AttributeError, KeyError, OverflowError, RecursionError, TypeError, ValueError) as error:
        raise ClodError(f"{path}: its description is damaged ({error!r:.80}); export the file again") from error


def settings_of(card: Metadata) -> AttenuationConfig:
    """How the file's sigma_d is to be read: by the defaults, of earlier versions in a description without settings."""
    unsaid = AttenuationConfig(**as_before({})[0]) if card.version else AttenuationConfig()
    return card.attenuation or unsaid


def _attenuation(values: dict[str, Any], notes: list[str]) -> AttenuationConfig:
    kinds: dict[str, Any] = {field.name: type(field.default) for field in fields(AttenuationConfig)}
    if unknown := [name for name in values if name not in kinds]:
        notes.append(f"settings unknown to this version ignored: {', '.join(unknown)}")
    known, remarks = as_before({name: kind(values[name]) for name, kind in kinds.items() if name in values})
    notes += remarks
    return AttenuationConfig(**known)


def _calibration(values: dict[str, Any], total: int) -> tuple[Calibration | None, list[str]]:
    if "calibration" not in values:
        return None, []
    try:
        calibration = Calibration.from_dict(values["calibration"])
    except (AttributeError, ClodError, KeyError, OverflowError, TypeError, ValueError) as error:
        return None, [f"the calibration is unusable and ignored ({error!s:.80})"]
    if calibration.total != total:
        return None, [f"the calibration is of {calibration.total} Gaussians and ignored, these are {total}"]
    return calibration, []
