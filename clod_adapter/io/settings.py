"""What a file does not say of its dial: how the settings that it is silent on are filled in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from clod_adapter.config import AttenuationConfig

WARNING = "warning: "  # begins a note that must not be missed
# What was the default when descriptions could leave a setting out.
BEFORE: dict[str, Any] = {
    "tau": 1 / 255, "cut": "hard", "eps": 1e-8, "normalizer": "scene", "quantile": 0.95, "scene_distance": 1.0,
    "max_sv": 5.0,
}  # fmt: skip


def as_before(stored: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The settings of a file with a description, BEFORE where that is silent, and a note on what was filled in.

    The reference distance of a description without one is its ``scene_distance``, which was the typical distance.
    """
    values = {**BEFORE, **stored}
    values.setdefault("reference_distance", values["scene_distance"])
    missing = [name for name in BEFORE if name not in stored]
    return values, [f"settings that are missing have the defaults of earlier versions: {', '.join(missing)}"] * bool(
        missing
    )


def with_range(values: dict[str, Any]) -> AttenuationConfig:
    """The settings; where no ``max_sv`` is known the default, or the largest that their tau allows.

    Raises:
        ClodError: a value is no setting.
    """
    usual = AttenuationConfig()
    if "max_sv" not in values and values.get("tau", 0.0) * usual.max_sv >= 1:
        values = values | {"max_sv": max(0.99 / values["tau"], 1.0)}
    return AttenuationConfig(**values)
