"""The container of Gaussians: shapes, activations, selection, and SH degrees."""

import re

import numpy as np
import pytest
import torch

from clod_adapter import AttenuationConfig, ClodError, Gaussians
from scenes import gaussians as some_gaussians

CONFIG = AttenuationConfig()


def gaussians(**changes: object) -> Gaussians:
    return some_gaussians(5, 2, 0).replace(**changes)


def adapted() -> Gaussians:
    return gaussians(sigma_d=torch.arange(5.0), attenuation=CONFIG)


def test_wrong_shapes_are_named() -> None:
    for name, shape in (
        ("means", (5, 2)), ("quats", (5, 3)), ("log_scales", (4, 3)), ("opacity_logits", (5, 1)), ("sh0", (5, 3)),
        ("shN", (5, 7, 3)), ("shN", (4, 8, 3)), ("shN", (5, 8, 4)), ("sigma_d", (4,)), ("growth_d", (5, 1)),
    ):  # fmt: skip
        with pytest.raises(ClodError, match=rf"Gaussians.{name} has shape {re.escape(str(shape))}, expected"):
            adapted().replace(**{name: torch.zeros(shape)})
    for changes in ({"sigma_d": torch.ones(5)}, {"attenuation": CONFIG}):
        with pytest.raises(ClodError, match="both sigma_d and attenuation"):
            gaussians(**changes)


@pytest.mark.parametrize(("degree", "used"), [(0, 0), (1, 0), (2, 1), (3, 3), (4, 1)])
def test_empty_sh_degrees_are_removed(degree: int, used: int) -> None:
    """The highest degrees that are 0 are removed; one coefficient keeps its degree and all below."""
    some, bands = some_gaussians(7, degree, 0), (used + 1) ** 2 - 1
    some.shN[:, max(used**2 - 1, 0) :] = 0
    if used:
        some.shN[4, bands - 1, 2] = -1e-30
    found = some.without_empty_bands()
    assert found.sh_degree == used and torch.equal(found.shN, some.shN[:, :bands])
    assert found is some if used == degree else torch.equal(found.means, some.means)


def test_rows_by_brackets() -> None:
    some = adapted()
    for rows, wanted in (
        (slice(3), [0, 1, 2]), (slice(None, None, 2), [0, 2, 4]), ([3, 0], [3, 0]), (np.array([4, -1]), [4, 4]),
        (np.array([0, 1, 1, 0, 0], bool), [1, 2]), (some.sigma_d > 2.5, [3, 4]), ([], []),
    ):  # fmt: skip
        found = some[rows]
        assert found.attenuation is CONFIG and len(found) == len(wanted)
        for name, value in found.tensors().items():
            assert torch.equal(value, getattr(some, name)[wanted]), name


@pytest.mark.parametrize("rows", [2, torch.ones(4, dtype=torch.bool), [5], torch.zeros(2, 2, dtype=torch.long)])
def test_other_rows_are_refused(rows: object) -> None:
    with pytest.raises(ClodError, match="give a slice, indices .M. or a mask .5.|there are 5 Gaussians, and index 5"):
        adapted()[rows]


def test_gaussians_are_compared_as_a_whole() -> None:
    some = adapted()
    assert some == some.replace(**{name: value.double().numpy() for name, value in some.tensors().items()})
    for other in (
        some[:4], some.replace(means=some.means + 1), some.replace(means=some.means.double()), gaussians(), "text",
        some.replace(growth_d=torch.ones(5)), some.replace(attenuation=AttenuationConfig(max_sv=2)),
    ):  # fmt: skip
        assert (some == other) is False


def test_repr_is_short_and_devices_have_names() -> None:
    some = adapted()
    assert repr(gaussians()) == "Gaussians(5, SH degree 2, no dial, cpu)"
    assert repr(some.replace(growth_d=torch.ones(5))) == "Gaussians(5, SH degree 2, dial to 5 with growth, cpu)"
    assert repr(some.to("meta")) == "Gaussians(5, SH degree 2, dial to 5, meta)"
    assert some.cpu().means.device.type == "cpu"
