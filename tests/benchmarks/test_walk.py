"""The walk from near to far: its path, levels and budget, what is computed from a row, and the page's tables."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import city
import common
import numpy as np
import pytest
import torch
import walk
import walk_page
import walk_town
from city_surfaces import LOT, build, extent

from clod_adapter.equation.attenuation import dial
from clod_adapter.equation.distances import in_frustum, typical_distance
from clod_adapter.gaussians import Gaussians

TOWN = walk_town.Town(count=2000, width=48, height=32, photographs=6, samples=2, tuning=2, iters=2)
FOUR_BLOCKS = 120_000


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A whole run on a tiny town; the merged levels are rows of the base, as the tool may be missing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(walk_town, "CACHE", tmp_path_factory.mktemp("cache"))
        patch.setattr(walk, "merge", lambda base, count: (common.head(base.gaussians, count), 0.0))
        row = walk.measure(TOWN, 9, 1, 0.05)
        model, _ = walk_town.adapted(TOWN)
        return SimpleNamespace(row=row, model=model)


@pytest.mark.parametrize("count", [10_000, FOUR_BLOCKS, 300_000])
def test_the_path_begins_at_a_door_and_follows_its_street(count: int) -> None:
    path = walk_town.Town(count=count).path(41)
    door, street = walk_town.doorstep(count)
    away = [float(np.linalg.norm(camera.position.numpy() - door)) for camera in path]
    assert away == pytest.approx(walk_town.distances(41), rel=1e-3)
    assert (away[0], away[-1]) == pytest.approx((walk_town.NEAREST, 100 * walk_town.NEAREST), rel=1e-3)
    assert all(abs(float(camera.viewmat[2] @ torch.tensor([*door.tolist(), 1.0])) / d - 1) < 1e-3
               for camera, d in zip(path, away, strict=True))  # fmt: skip
    walls = build(count, np.random.default_rng(0))
    house = (walls.kind == walk_town.FACADE) & (walls.normal[:, 0] > 0.9) & (walls.origin[:, 1] == 0)
    middle = (walls.origin + (walls.u + walls.v) / 2)[house]
    deep, top = np.abs((walls.u + walls.v)[house][:, 2]), -2 * middle[:, 1]
    for camera in path:
        x, y, z = camera.position.tolist()
        inside = (x < middle[:, 0]) & (x > middle[:, 0] - 0.68 * LOT) & (np.abs(z - middle[:, 2]) < deep / 2)
        assert door[0] < x < street + 1e-3 and not (inside & (-y < top)).any(), camera.name


def test_fields_begin_below_the_city() -> None:
    for count in (FOUR_BLOCKS, 300_000):
        around = city.city(count, sh_degree=0).means[count - city.surrounding(count) :]
        fields = around[around[:, 1] == 1.2]
        assert len(fields) > 1000 and float(fields[:, [0, 2]].norm(dim=1).min()) < extent(count).min() / 2 + 1


def test_truth_is_the_mean_of_the_samples() -> None:
    camera = TOWN.cameras()[1]
    large = city.look_at(np.array([0.0, -5, -30]), np.zeros(3), 2 * TOWN.width, 2 * TOWN.height, "")
    small = city.look_at(np.array([0.0, -5, -30]), np.zeros(3), TOWN.width, TOWN.height, "")
    image = walk_town.clod.render(TOWN.truth(), large).image.clamp(0, 1)
    mean = torch.nn.functional.avg_pool2d(image.permute(2, 0, 1), 2).permute(1, 2, 0)
    assert (TOWN.photograph(small).image / 255 - mean).abs().max() < 0.01
    assert TOWN.photograph(camera).camera is camera


def four_blocks(many: int = 400) -> Gaussians:
    """Evenly spread rows of a town of 2 x 2 blocks."""
    return city.city(FOUR_BLOCKS, sh_degree=0).select(torch.arange(0, FOUR_BLOCKS, FOUR_BLOCKS // many))


def test_each_block_shows_one_level() -> None:
    town, fine = walk_town.Town(count=FOUR_BLOCKS), four_blocks()
    coarse = fine.select(torch.arange(0, len(fine), 3)).replace(opacity_logits=torch.full((len(fine) // 3 + 1,), 9.0))
    levels = walk_town.Levels([fine, coarse], town)
    where = walk_town.block_of(fine.means, town.count)
    assert where.bincount().min() > 0.1 * len(fine) and len(where.bincount()) == 4
    drawn = levels.drawn((0, 1, 1, 0))
    second = drawn.opacity_logits == 9
    assert torch.equal(second, (lambda cell: (cell == 1) | (cell == 2))(walk_town.block_of(drawn.means, town.count)))
    assert int((~second).sum()) == int(((where == 0) | (where == 3)).sum())
    assert int(second.sum()) == int(((where == 1) | (where == 2))[::3].sum())


def test_levels_follow_the_distance_in_octaves(measured: Any) -> None:
    """A level is drawn from sqrt(1/2) to sqrt(2) times the distances at which the dial shows the same."""
    model = measured.model
    typical = typical_distance(model.means, TOWN.cameras(), model.attenuation)
    path = TOWN.path(61)
    chosen = walk_town.choose(model, TOWN, path, walk.LEVELS)
    for camera, (level,) in zip(path, chosen, strict=True):
        ratio = float(((model.means - camera.position).norm(dim=1) / typical).log().mean().exp())
        expected = 0 if ratio < 0.5**0.5 else next(k + 1 for k in range(9) if ratio < 2 ** (k + 0.5))
        assert level == min(expected, len(walk.LEVELS)), camera.name
    assert {0, 1, 2} <= {level for (level,) in chosen}


def test_the_budget_is_held(measured: Any) -> None:
    path, model = TOWN.path(9), measured.model
    for camera, s in zip(path, walk_town.held(model, path, 100), strict=True):
        kept = int((dial(model, camera, s).keep & in_frustum(model.means, camera)).sum())
        more = int((dial(model, camera, max(1, 0.99 * s)).keep & in_frustum(model.means, camera)).sum())
        assert 1 <= s <= TOWN.max_sv and (kept <= 100 or s == TOWN.max_sv) and (more >= 100 or s == 1), camera.name
    assert walk_town.held(model, path, 1)[0] == TOWN.max_sv


def test_a_run_has_every_method_in_every_frame(measured: Any) -> None:
    row = measured.row
    assert set(row["frames"]) == set(walk_page.COLOURS)
    assert all(len(values) == 9 for each in row["frames"].values() for values in each.values())
    assert all(min(each["ms"]) > 0 and math.isfinite(sum(each["psnr"])) for each in row["frames"].values())
    base, far = row["frames"]["base"]["in_view"], row["frames"]["dial, s = 1"]["in_view"]
    assert all(a >= b for a, b in zip(base, far, strict=True)) and sum(base) > sum(far), "the dial culls at s = 1"
    assert set(row["changes"]) == set(walk_page.COLOURS) - {"base"}
    switched = [a != b for a, b in zip(row["chosen"], row["chosen"][1:], strict=False)]
    assert any(switched) and switched == [change > 0 for change in row["changes"]["levels"]["each"]]
    assert len(row["equal"]) == walk.SOME and len(row["equal"][0]["dial"]) == len(walk.TURNED)
    counts = [row["counts"]["base"], *row["counts"]["levels"]]
    assert counts == sorted(counts, reverse=True) and counts[-1] < counts[0] / 10


def test_a_figure_is_drawn(measured: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(walk_page, "PICTURE", tmp_path / "images" / "walk.png")
    walk_page.draw(measured.row, TOWN)
    assert (tmp_path / "images" / "walk.png").stat().st_size > 20_000


def test_time_saved_is_that_of_the_fastest_setting_that_is_good_enough() -> None:
    def points(*pairs: tuple[float, float]) -> list[dict[str, float]]:
        return [{"ms": ms, "psnr": psnr} for ms, psnr in pairs]

    near = {"base": points((10, 30)), "dial": points((8, 30.5), (6, 29.95), (5, 29.8)), "levels": points((1, 20))}
    far = {"base": points((30, 30)), "dial": points((12, 30), (9, 29.8), (6, 29)), "levels": points((9, 29.8))}
    row = {"equal": [near, far]}
    assert walk_page.saved(row, "dial", 0.1, False) == pytest.approx(1 - (6 + 12) / 40)
    assert walk_page.saved(row, "dial", 0.25, False) == pytest.approx(1 - (5 + 9) / 40)
    assert walk_page.saved(row, "dial", 0.25, True) == pytest.approx(1 - (8 + 9) / 40)
    assert walk_page.saved(row, "levels", 0.25, False) == pytest.approx(1 - (10 + 9) / 40), "the base where none is"


def test_a_page_is_filled_in(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- one: written by x.py -->\n\nold\n\n<!-- end of one -->\nafter\n", encoding="utf-8")
    for text in ("new \\1", "newer"):
        common.fill_in(page, "one", text)
        assert capsys.readouterr().out == f"{text}\n"
    assert page.read_text("utf-8") == "before\n<!-- one: written by x.py -->\n\nnewer\n\n<!-- end of one -->\nafter\n"


def test_the_page_has_the_tables_of_the_last_row() -> None:
    assert walk_page.summary(common.stored(walk_page.FILE)[-1]) in walk_page.PAGE.read_text(encoding="utf-8")
