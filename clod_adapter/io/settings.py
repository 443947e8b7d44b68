"""Settings that travel with a file: one reader for PLY comments, PLY columns and JSON documents.

Each format gives the same mapping of names to values, whose numbers may be text::

    attenuation    the fields of AttenuationConfig
    screen_filter  the fields of ScreenFilter, or the words "variance compensate"
    calibration    as Calibration.as_dict
    origin         [x, y, z]
    about          lines of text
    package_version

The same rules hold everywhere: an unknown field is ignored with a note, a damaged setting is refused, and a damaged
calibration, which rendering does not need, is ignored with a note.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from clod_adapter._support.version import package_version
from clod_adapter.calibration import Calibration
from clod_adapter.config import CLASSIC, AttenuationConfig, ScreenFilter
from clod_adapter.errors import ClodError
from clod_adapter.origin import NOWHERE, Origin, parse_origin

WARNING = "warning: "  # prefix of a note that must not be missed
FILTER = "screen_filter"
# Defaults of earlier versions, for files whose description lacks a setting.
EARLIER: dict[str, Any] = {
    "tau": 1 / 255, "cut": "hard", "eps": 1e-8, "normalizer": "scene", "quantile": 0.95, "scene_distance": 1.0,
    "max_sv": 5.0,
}  # fmt: skip
DAMAGE = (AttributeError, KeyError, OverflowError, RecursionError, TypeError, ValueError)
_LONGEST = 1 << 16  # characters of ``about``; a PLY header must have room for them
_INHERITED = 60_000  # of these, for lines that an output inherits; the rest is for its own
_OVERHEAD = 9  # bytes of a PLY's comment besides its text


@dataclass(frozen=True)
class Metadata:
    """The settings of a file.

    Attributes:
        attenuation: of sigma_d; None for a file without one.
        screen_filter: None where the file does not store one.
        calibration: as stored; ``matching_calibration`` compares it with the Gaussians.
        origin: what the means are relative to, world units.
        about: lines on the history of the file.
        version: of the package that wrote the file; "" for another program.
        described: whether the file has a description by this package.
        notes: what was filled in or ignored, one line each.
    """

    attenuation: AttenuationConfig | None = None
    screen_filter: ScreenFilter | None = None
    calibration: Calibration | None = None
    origin: Origin = NOWHERE
    about: tuple[str, ...] = ()
    version: str = ""
    described: bool = False
    notes: tuple[str, ...] = ()


def read_metadata(path: Path, values: Mapping[str, Any], *, dial: bool, described: bool = True) -> Metadata:
    """The settings in a mapping.

    Args:
        dial: whether the file has sigma_d. If so, missing settings take their defaults.
        described: whether the values are a description by this package, where missing settings take the defaults of
            earlier versions (``EARLIER``).

    Raises:
        ClodError: a setting is damaged or out of range.
    """
    notes: list[str] = []
    try:
        about, version = tuple(map(str, values.get("about", ()))), values.get("package_version", "")
        if not isinstance(version, str):
            raise TypeError(f"package_version is {version!r:.40}, not a string")
        if sum(map(len, about)) + len(version) > _LONGEST:
            raise ValueError(f"more than {_LONGEST:,} characters of text")
        return Metadata(
            attenuation=_attenuation(values.get("attenuation", {}), described, notes) if dial else None,
            screen_filter=_screen_filter(values[FILTER], notes) if FILTER in values else None,
            calibration=_calibration(values.get("calibration"), notes),
            origin=parse_origin(values.get("origin", NOWHERE)),
            about=about, version=version, described=described, notes=tuple(notes),
        )  # fmt: skip
    except (ClodError, *DAMAGE) as error:
        raise damaged(path, error) from error


def that_fit(lines: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The lines of a file's history that every output has room for, the last ones first; and a note on the others."""
    kept, room = list[str](), _INHERITED
    for line in reversed(lines):
        if len(line) + _OVERHEAD <= room:
            kept.append(line)
            room -= len(line) + _OVERHEAD
    if len(kept) == len(lines):
        return tuple(lines), ()
    note = f"{len(lines) - len(kept)} of {len(lines)} comments are not carried over to outputs, which have room for "
    return tuple(reversed(kept)), (f"{note}{_INHERITED:,} characters",)


def damaged(path: Path, error: Exception) -> ClodError:
    """The error of a file with damaged settings, whatever the format."""
    reason = str(error) if isinstance(error, ClodError) else repr(error)
    return ClodError(f"{path}: its settings are damaged ({reason:.120}); restore them, or export the file again")


def matching_calibration(metadata: Metadata, count: int) -> tuple[Calibration | None, list[str]]:
    """The calibration if it was measured on ``count`` Gaussians; else None and a note."""
    found = metadata.calibration
    if found is None or found.total == count:
        return found, []
    return None, [f"the calibration is of {found.total} Gaussians and ignored, these are {count}"]


def stored_values(
    attenuation: AttenuationConfig | None, screen_filter: ScreenFilter, origin: Origin, calibration: Calibration | None
) -> dict[str, Any]:
    """Plain JSON that ``read_metadata`` inverts; the classic filter and an origin of 0 are left out."""
    values: dict[str, Any] = {} if attenuation is None else {"attenuation": asdict(attenuation)}
    values |= {} if screen_filter == CLASSIC else {FILTER: asdict(screen_filter)}
    values |= {"origin": list(origin)} if any(origin) else {}
    return values | ({} if calibration is None else {"calibration": calibration.as_dict()})


def document(kind: str, version: int) -> dict[str, Any]:
    """The beginning of a JSON document: what it is, and the package that writes it."""
    return {"format": kind, "format_version": version, "package_version": package_version()}


def _attenuation(stored: Mapping[str, Any], described: bool, notes: list[str]) -> AttenuationConfig:
    kinds: dict[str, Any] = {field.name: type(field.default) for field in fields(AttenuationConfig)}
    values = {name: kind(stored[name]) for name, kind in kinds.items() if name in stored}
    if described:
        if missing := [name for name in EARLIER if name not in stored]:
            notes.append(f"settings that are missing have the defaults of earlier versions: {', '.join(missing)}")
        values = EARLIER | values
        values.setdefault("reference_distance", values["scene_distance"])  # earlier: the same number
    elif "max_sv" not in values and values.get("tau", 0.0) * AttenuationConfig().max_sv >= 1:
        values["max_sv"] = max(0.99 / values["tau"], 1.0)  # the largest that this tau allows
    _note_unknown(stored, kinds, notes)
    return AttenuationConfig(**values)


def _screen_filter(stored: Any, notes: list[str]) -> ScreenFilter:
    if isinstance(stored, str):
        stored = dict(zip(("variance", "compensate"), stored.split(), strict=True))
    compensate = {"True": True, "False": False}.get(stored["compensate"], stored["compensate"])
    _note_unknown(stored, ("variance", "compensate"), notes)
    return ScreenFilter(variance=float(stored["variance"]), compensate=compensate)


def _calibration(stored: Any, notes: list[str]) -> Calibration | None:
    try:
        return None if stored is None else Calibration.from_dict(stored)
    except (ClodError, *DAMAGE) as error:
        notes.append(f"the calibration is unusable and ignored ({error!s:.80})")
        return None


def _note_unknown(stored: Mapping[str, Any], known: Any, notes: list[str]) -> None:
    if unknown := [name for name in stored if name not in known]:
        notes.append(f"settings unknown to this version ignored: {', '.join(map(repr, unknown))}")
