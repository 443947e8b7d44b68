"""Everything that uses a dial follows sigma_d in its unit and the growth of one function, and gives
on another device, which it neither waits for nor leaves, what it gives on the CPU: a GPU, or else a
simulated one (``fake_gpu``).
"""

import importlib
from dataclasses import replace
from itertools import chain

import pytest
import torch
from torch import Tensor

import gsplat_in_torch
from clod_adapter import Hook, Scene, attach, dial_for, evaluate, make_plan, render
from clod_adapter.adapter import detach, with_dial
from clod_adapter.alignment.check import check_alignment
from clod_adapter.bake import bake
from clod_adapter.config import AdaptConfig, AttenuationConfig
from clod_adapter.equation.units import in_world_units
from clod_adapter.evaluation.budget import frame_times, matching_dial
from clod_adapter.evaluation.popping import dial_popping, path_popping
from clod_adapter.gaussians import with_near
from clod_adapter.initialization.importance import for_training
from clod_adapter.integrations.splats import from_gsplat, to_gsplat
from clod_adapter.rasterizers import BACKENDS, Rasterizer, cpu, cuda
from clod_adapter.training.camera_placement import place_cameras
from clod_adapter.training.far_reach import fit_far_reach
from clod_adapter.training.pseudo_views import PseudoView, render_pseudo_views
from clod_adapter.training.schedule import Sample
from clod_adapter.training.trainer import Trainer
from clod_adapter.training.tuning import tune
from fake_gpu import fake_gpu, waits
from scenes import gaussians, photograph, ring, seeded

N, DIAL = 120, 2.0
CAMERAS = ring(3, 24, 18)
CONFIG = AdaptConfig(max_sv=4.0)


def model_of():
    sigma_d = 0.3 + 4 * torch.rand(N, generator=seeded(1))
    settings = AttenuationConfig(scene_distance=4.0, reference_distance=4.0, max_sv=4.0)
    return with_dial(gaussians(N, 1, 0, size=0.15), sigma_d, settings, torch.linspace(-0.5, 1, N))


def views_of(model):
    return photograph(detach(model).cpu(), CAMERAS)


def rendering(model):
    found = render(model, CAMERAS[0], DIAL)
    return [found.image, found.alpha, found.kept]


def evaluation(model):
    rows = evaluate(model, views_of(model), [1.0, DIAL])
    return list(chain(*((row.psnr, row.ssim, row.kept, row.in_view) for row in rows)))


def objective(config):
    def gradients(model):
        run = Trainer(model, views_of(model), config)
        found = run.gradient_sum([Sample(views_of(model)[0], DIAL, 3.0)])
        return [found.loss, found.kept, *found.gradients.values()]

    return gradients


def papers_objective(model):
    paper = model.replace(growth_d=None, attenuation=replace(model.attenuation, form="paper"))
    return objective(AdaptConfig.paper(max_sv=4.0))(paper)


def objective_of_far_ones(model):
    far = model.replace(attenuation=replace(model.attenuation, near_distance=5.0))
    return objective(CONFIG)(with_near(detach(model), far))


def budget(**given):
    return lambda model: [dial_for(model, keep=float(n), **given).virtual_scale for n in (20, 25)]


def baked(**given):
    return lambda model: list(bake(model, DIAL, **given).tensors().values())


def hook(model):
    own = model.cpu()  # the hook follows the means
    attenuated = Hook(own.sigma_d, own.attenuation, DIAL, own.growth_d)
    return list(attenuated(model.means, model.opacities, CAMERAS[0].viewmat))


def popping(model):
    return [
        dial_popping(model, CAMERAS[0], DIAL, steps=2).mean,
        path_popping(model, CAMERAS[:2], DIAL, steps=2).mean,
    ]


CONSUMERS = {
    "render": rendering,
    "evaluate": evaluation,
    "objective": objective(CONFIG),
    "objective of far Gaussians": objective_of_far_ones,
    "dial_for one camera": budget(cameras=CAMERAS[:1]),
    "dial_for several cameras": budget(cameras=CAMERAS),
    "dial_for a baked file": budget(cameras=CAMERAS, baked=True),
    "bake for one camera": baked(camera=CAMERAS[0]),
    "bake for several cameras": baked(cameras=CAMERAS),
    "Hook": hook,
    "popping": popping,
}


def same(these, those):
    pairs = list(zip(these, those, strict=True))
    return all(torch.equal(a, b) if isinstance(a, Tensor) else a == b for a, b in pairs)


def agree(these, those, within):
    """To this share of each result."""
    for pair in zip(these, those, strict=True):
        a, b = (torch.as_tensor(value).cpu().double() for value in pair)
        if (a - b).norm() > within * b.norm() + 1e-6:
            return False
    return True


# Growth is no part of the culling rule.
WITHOUT_GROWTH = {name for name in CONSUMERS if "dial_for" in name}


@pytest.mark.parametrize("name", CONSUMERS)
def test_everything_follows_sigma_d_in_its_unit_and_growth(name):
    """Reaches of other Gaussians change the result; the same ones in another unit do not, to
    rounding. Growth changes whatever draws, and no count.
    """
    consumer = CONSUMERS[name]
    model = model_of()
    before = consumer(model)
    assert not same(consumer(model.replace(sigma_d=model.sigma_d.flip(0))), before)
    assert agree(consumer(in_world_units(model)), before, 1e-4)
    grown = consumer(model.replace(growth_d=model.growth_d + 0.5))
    assert same(grown, before) == (name in WITHOUT_GROWTH)


SHORT = replace(CONFIG, iters=1)


def on_the_cpu(*given):
    """The CPU's kernels in place of gsplat's, which take long in torch on the simulated device."""
    moved = [each.cpu() if isinstance(each, Tensor) else each for each in given]
    return tuple(each.to(given[0].device) for each in cpu.rasterize(*moved))


@pytest.fixture
def there(monkeypatch):
    """Gaussians with a dial, on the device."""
    pytest.importorskip("gsplat", reason="pip install gsplat==1.5.3")
    if torch.cuda.is_available():
        yield model_of().to("cuda:0")
        return
    gsplat_in_torch.install(monkeypatch)
    monkeypatch.setitem(BACKENDS, "gpu", lambda: Rasterizer(on_the_cpu))
    with fake_gpu() as device:
        yield model_of().to(device)


def own_loop(model):
    """Loss and gradients of a dial that a training loop of one's own learns."""
    splats = torch.nn.ParameterDict(
        {n: torch.nn.Parameter(x.clone()) for n, x in to_gsplat(detach(model)).items()}
    )
    attenuated = attach(from_gsplat(splats), CAMERAS, CONFIG)
    groups = attenuated.param_groups(splats=True)
    loss = attenuated.loss(
        DIAL, render(attenuated.gaussians(), CAMERAS[0], DIAL).image.square().mean()
    )
    loss.backward()
    assert len(groups) == 8 and attenuated(CAMERAS[0], DIAL).drawn.device == model.means.device
    return [loss.detach(), *(group["params"][0].grad for group in groups)]


def far_reach(model):
    views = render_pseudo_views(model, CAMERAS[:1]).train
    start = make_plan(detach(model), Scene(views, ()), CONFIG).start
    return [fit_far_reach(start, views).sigma_d]


RUNS = CONSUMERS | {
    "a loop of one's own": own_loop,
    "the reach of far Gaussians": far_reach,
    "the paper's objective": papers_objective,
    "alignment": lambda model: [check_alignment(model, views_of(model)).psnr],
    "matching_dial": lambda model: [matching_dial(model, CAMERAS, 20)],
    "placed cameras": lambda model: [place_cameras(model, views=1)[0].viewmat.numpy()],
    "tuning": lambda model: [tune(detach(model), views_of(model), 2).sh0],
    "pseudo views": lambda model: [render_pseudo_views(model, CAMERAS[:1]).train[0].image.numpy()],
}


@pytest.mark.parametrize("name", RUNS)
def test_results_are_there_and_those_of_the_cpu(there, name, monkeypatch):
    """To the difference of two rasterizers."""
    if name in ("render", "objective"):
        monkeypatch.setitem(BACKENDS, "gpu", lambda: Rasterizer(cuda.rasterize))
    found = RUNS[name](there)
    assert all(each.device == there.means.device for each in found if isinstance(each, Tensor))
    assert agree(found, RUNS[name](there.cpu()), 2e-2)


def test_training_stays_there(there, monkeypatch):
    """By a plan, whose left-out parts are restored."""
    plain = detach(there)
    scene = Scene(views_of(there)[:1], ())
    plan = make_plan(plain, scene, SHORT)
    trained = plan.adapt(scene).gaussians
    assert not torch.equal(trained.means.cpu(), plan.start.means.cpu())
    assert trained.whole == len(plain)
    for values in trained.tensors().values():
        assert values.device == plain.means.device and bool(values.isfinite().all())
    monkeypatch.setattr(importlib.import_module("clod_adapter.evaluation.frame_times"), "PASSES", 2)
    assert all(taken > 0 for _, taken in frame_times(there, CAMERAS[:1])[0])


def test_a_step_waits_for_the_device_once(there, monkeypatch):
    """At its end, for the loss; the rasterizer aside: gsplat itself asks how many rows and tiles
    there are.
    """
    if there.means.is_cuda:
        pytest.skip("the simulated device tells where the host waits")
    monkeypatch.setitem(BACKENDS, "gpu", lambda: Rasterizer(cuda.rasterize))
    views = views_of(there)[:1]
    moving = [PseudoView(view.camera, there, 1.0) for view in views]
    config = replace(CONFIG, batch=2)
    trainer = Trainer(for_training(there), (*views, *moving), config)
    for share_done in (0.1, 0.9):
        with waits() as found:
            trainer.step(share_done)
        places = [place for place in found if not place.startswith("rasterizers/")]
        assert places == ["training/trainer.py:step"]
