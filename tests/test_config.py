"""Settings: every field has a description, and impossible values are refused."""

import math
import re
from typing import Any

import pytest

from clod_adapter.config import AdaptConfig, AttenuationConfig, ScreenFilter, field_descriptions
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
        "eps": [-1e-9, 1.0, math.nan], "normalizer": ["mean"], "cut": ["none"],
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


def test_limits_are_accepted() -> None:
    edges = {"tau": 1e-6, "max_sv": 1.0, "iters": 0, "time_budget": 0.1, "start_share": 1.0, "exponent": 0.1}
    AdaptConfig(**edges, reg_weight=0.0, ssim_weight=1.0, lr_means=0.0)
    AttenuationConfig(tau=0.19, max_sv=5.0)  # something must pass the threshold at the end of the dial
    with pytest.raises(ClodError, match="below 1/max_sv = 0.2"):
        AttenuationConfig(tau=0.21, max_sv=5.0)


@pytest.mark.parametrize("kind", TABLES)
def test_every_field_has_help_and_a_default(kind: type) -> None:
    texts = field_descriptions(kind)
    assert all(len(text) > 10 and text == text.strip().rstrip(".") for text in texts.values())
    assert list(texts) == list(vars(kind()))
    with pytest.raises(TypeError):  # by keyword alone, as fields may move
        kind(0.5)


def test_the_papers_form() -> None:
    paper = AdaptConfig.paper(max_sv=7, reg_weight=0.0)
    assert (paper.form, paper.max_sv, paper.iters, paper.lr_sigma, paper.reg_weight) == ("paper", 7, 1600, 1e-2, 0)
