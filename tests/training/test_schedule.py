"""The schedule: each view once a round, dial values evenly spread, reproducibly from a seed or a state."""

import math
from dataclasses import replace

import torch

from clod_adapter import AdaptConfig, View
from clod_adapter.training.schedule import OURS, PAPER, Schedule, ViewSampler
from scenes import capture

VIEWS = capture(n=20)[1].train


def assert_uniform(values: torch.Tensor) -> None:
    """In [0, 1], and more evenly than random numbers would be."""
    values = values.sort().values.double()
    assert (values - torch.linspace(0, 1, len(values))).abs().max() < 3 / len(values)


def test_dial_values_follow_the_schedule() -> None:
    """1, or 0, in a falling share of the steps, else (log-)uniform from 1 on; in every stretch."""

    def drawn(schedule: Schedule, share_done: float = 0.0, tau: float | None = None) -> torch.Tensor:
        sampler = ViewSampler(VIEWS, AdaptConfig(max_sv=4.0), tau, schedule)
        samples = [sampler.draw(k, share_done) for k in range(480)]
        names = [sample.view.camera.name for sample in samples]  # each view once a round
        assert all(len({*names[k : k + len(VIEWS)]}) == len(VIEWS) for k in range(0, 480, len(VIEWS)))
        return torch.tensor([sample.dial for sample in samples], dtype=torch.float64)

    for stretch in drawn(Schedule(full=0.25)).split(120):
        assert abs(int((stretch <= 1).sum()) - 30) <= 1 and abs(int((stretch == 0).sum()) - 7.5) <= 1
        assert_uniform(stretch[stretch > 1].log() / math.log(OURS.rendered * 4.0))
    assert_uniform((drawn(PAPER) - 1) / 3)
    assert abs(int((drawn(Schedule(full=0.5, full_final=0.5), 0.5) <= 1).sum()) - 0.375 * 480) <= 1
    assert ViewSampler(VIEWS, AdaptConfig(max_sv=1.0)).draw(0, 0.0)[1:] == (1.0, None, False)
    assert drawn(Schedule(full=0.0), tau=0.2).max() < (4 + 1 / 0.2) / 2  # at 5 nothing is kept


def test_first_steps_have_photographs_of_half_the_size() -> None:
    """Unless these would be small, or the step is at s = 1."""
    camera = replace(VIEWS[0].camera, width=301, height=258, K=torch.tensor([[90.0, 0, 150], [0, 90, 129], [0, 0, 1]]))
    image = torch.randint(256, (258, 301, 3), generator=torch.Generator().manual_seed(0)).byte()
    large, small = View(camera, image), View(replace(camera, height=255), image[:255])
    cases = ((large, 0.49, 0.0, True), (large, 0.5, 0.0, False), (small, 0.0, 0.0, False), (large, 0.0, 1.0, False))
    for view, share_done, full, expected in cases:
        schedule = Schedule(coarse=0.5, full=full)
        sample = ViewSampler((view,), AdaptConfig(), None, schedule).draw(0, share_done)
        assert sample.halved == expected and (sample.view is view) != expected
