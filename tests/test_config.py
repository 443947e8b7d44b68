"""Settings: every field has a description, and impossible values are refused."""

from __future__ import annotations

import dataclasses
import math
import re
from typing import Any

import pytest

from clod_adapter.config import FILTERS, AdaptConfig, AttenuationConfig, ScreenFilter, field_descriptions
from clod_adapter.errors import ClodError

BOTH = {"tau": [0.0, 1.0, 0.2, math.nan], "max_sv": [0.99, math.inf, math.nan]}
RATES = ("sigma", "growth", "means", "quats", "scales", "opacities", "sh0", "shN")
TABLES: dict[type, dict[str, list[Any]]] = {
    AdaptConfig: BOTH | {
        "iters": [-1], "time_budget": [0.0, math.nan], "start_share": [0.5, 1.01], "exponent": [0.0, math.inf],
        "reg_weight": [-1.0, math.nan], "ssim_weight": [-0.1, 1.1], "form": ["theirs"], "growth": ["yes"],
        "batch": [0, 4097], "seed": [-1, 2**63], **{f"lr_{name}": [-1e-9, 1.1e6, math.nan] for name in RATES},
    },
    AttenuationConfig: BOTH | {
        "eps": [-1e-9, 1.0, math.nan], "normalizer": ["mean"], "quantile": [0.0, 1.01], "cut": ["none"],
        "scene_distance": [0.0, 1e308, math.nan], "reference_distance": [-1.0, math.inf],
    },
    ScreenFilter: {"variance": [9e-4, 101.0, math.nan], "compensate": [1, "yes", None]},
}  # fmt: skip


@pytest.mark.parametrize("kind", TABLES)
def test_impossible_values_are_named(kind: type) -> None:
    for name, values in TABLES[kind].items():
        for value in values:
            with pytest.raises(ClodError, match=re.escape(f"{name} is {value}, it must be ")):
                kind(**{name: value})


EDGES = {
    "tau": 1e-6, "max_sv": 1.0, "iters": 0, "time_budget": 0.1, "start_share": 1.0,
    "exponent": 0.1, "reg_weight": 0.0, "ssim_weight": 1.0, "lr_means": 0.0,
}  # fmt: skip


def test_limits_are_accepted() -> None:
    for name, value in EDGES.items():
        assert getattr(AdaptConfig(**{name: value}), name) == value
    AttenuationConfig(tau=0.19, max_sv=5.0)  # something must pass the threshold at the end of the dial
    with pytest.raises(ClodError, match="below 1/max_sv = 0.2"):
        AttenuationConfig(tau=0.21, max_sv=5.0)


@pytest.mark.parametrize("kind", TABLES)
def test_every_field_has_help_and_a_default(kind: type) -> None:
    texts = field_descriptions(kind)
    assert list(texts) == [field.name for field in dataclasses.fields(kind)] and field_descriptions(kind()) == texts
    assert all(len(text) > 10 and text == text.strip().rstrip(".") for text in texts.values())
    with pytest.raises(TypeError):  # by keyword alone, as fields may move
        kind(0.5)


def test_the_papers_form() -> None:
    paper = AdaptConfig.paper(max_sv=7, iters=10)
    assert (paper.form, paper.max_sv, paper.iters, paper.lr_sigma, paper.reg_weight) == ("paper", 7, 10, 1e-2, 1.0)
    assert AdaptConfig.paper(reg_weight=0.0).reg_weight == 0 and len(dataclasses.fields(paper)) == 20


def test_filters_by_their_names() -> None:
    assert [each.name for each in FILTERS.values()] == list(FILTERS) and ScreenFilter(variance=0.2).name is None
