"""``clod-splatfacto`` with the real nerfstudio on a CPU: its trainer, its commands' loading, its
viewer and its export.

Skipped where nerfstudio is absent. Without CUDA, open3d and pymeshlab, beside the packages of dev:

    pip install --no-deps nerfstudio==1.1.5 gsplat==1.4.0 nerfacc==0.5.2 torchmetrics \\
        pytorch-msssim timm==0.6.7 viser==0.2.7 tyro==0.9.8 tensorboard==2.14.1 \\
        "protobuf<=3.20.3" tensorly lightning-utilities comet_ml wandb
    pip install opencv-python-headless scikit-learn xatlas trimesh splines appdirs pyquaternion \\
        rawpy fpsample h5py pathos av gdown plotly python-socketio msgpack msgpack-numpy shtab \\
        docstring-parser typeguard msgspec yourdfpy

gsplat's kernels are torch (``gsplat_in_torch``); open3d, pymeshlab and the weights of LPIPS are
absent.
"""

import copy
import importlib
import sys
import tomllib
from types import ModuleType, SimpleNamespace

import pytest
import torch
from common import ROOT
from PIL import Image
from refusals import refused

import gsplat_in_torch
import scenes
from clod_adapter import load
from clod_adapter.render import render
from photographs import write_frames

N = 60
WIDTH = 32
HEIGHT = 24
STEPS = 16


@pytest.fixture
def nerfstudio(monkeypatch):
    pytest.importorskip("nerfstudio", reason="nerfstudio is not installed")
    monkeypatch.setenv("TORCHDYNAMO_DISABLE", "1")
    import torchmetrics.image.lpip

    monkeypatch.setattr(
        torchmetrics.image.lpip,
        "LearnedPerceptualImagePatchSimilarity",
        lambda **_: torch.nn.Module(),
    )
    monkeypatch.setattr(torch.Tensor, "cuda", lambda self, *args, **kwargs: self)
    for name in ("open3d", "pymeshlab", "mediapy"):  # of exports that are not tested here
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    gsplat_in_torch.install(monkeypatch)
    return importlib.import_module("clod_adapter.nerfstudio.method")


def write_capture(folder):
    """transforms.json with photographs; the splat that is to be adapted, in its frame."""
    base, scene = scenes.capture(N, 8, WIDTH, HEIGHT)
    frames = []
    for view in (*scene.train, *scene.test):
        Image.fromarray(view.image.numpy()).save(folder / view.camera.name)
        pose = torch.linalg.inv(view.camera.viewmat) * torch.tensor([1.0, -1.0, -1.0, 1.0])
        (fl_x, _, cx), (_, fl_y, cy), _ = view.camera.K.tolist()
        frame = {"file_path": view.camera.name, "transform_matrix": pose.tolist()}
        frames.append(frame | {"fl_x": fl_x, "fl_y": fl_y, "cx": cx, "cy": cy})
    write_frames(folder, frames, w=WIDTH, h=HEIGHT, camera_model="OPENCV")
    return base


def configured(method, folder, load_dir):
    """What ``ns-train clod-splatfacto --load-dir ...`` makes, in world coordinates and with a short
    training.
    """
    config = copy.deepcopy(method.config)
    parser = config.pipeline.datamanager.dataparser
    parser.data, parser.auto_scale_poses = folder, False
    parser.orientation_method = parser.center_method = "none"
    model = config.pipeline.model
    model.random_init, model.num_random, model.sh_degree = True, 10, 1
    model.background_color = "black"
    # all off
    model.warmup_length = 0
    model.refine_every = 2
    model.stop_split_at = 10**6
    model.cull_alpha_thresh = 0.5
    config.load_dir, config.output_dir, config.max_num_iterations = (
        load_dir,
        folder / "outputs",
        STEPS,
    )
    config.vis, config.machine.device_type, config.experiment_name = "tensorboard", "cpu", "capture"
    config.steps_per_eval_image = config.steps_per_eval_all_images = 1000
    config.set_timestamp()
    return config


def write_splatfacto(config, base, folder):
    from nerfstudio.models.splatfacto import SplatfactoModelConfig
    from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig

    own = config.pipeline
    model = SplatfactoModelConfig(random_init=True, num_random=10, sh_degree=1)
    pipeline = VanillaPipelineConfig(datamanager=own.datamanager, model=model).setup(
        device="cpu", test_mode="val"
    )
    for name, value in scenes.splatfacto_parameters(base).items():
        pipeline.model.gauss_params[name] = torch.nn.Parameter(value.clone())
    folder.mkdir()
    state = {
        "step": 29999,
        "pipeline": pipeline.state_dict(),
        "optimizers": {},
        "schedulers": {},
        "scalers": {},
    }
    torch.save(state, folder / "step-000029999.ckpt")


def trained(config):
    trainer = config.setup(local_rank=0, world_size=1)
    config.save_config()
    trainer.setup()
    trainer.train()
    return trainer


@pytest.fixture
def run(nerfstudio, tmp_path):
    base = write_capture(tmp_path)
    config = configured(nerfstudio.method, tmp_path, tmp_path / "splatfacto")
    write_splatfacto(config, base, tmp_path / "splatfacto")
    return SimpleNamespace(
        base=base, trainer=trained(config), config=config, folder=tmp_path, method=nerfstudio.method
    )


def test_the_entry_point_is_the_method(nerfstudio):
    from nerfstudio.plugins.types import MethodSpecification

    entries = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    module, _, name = entries["nerfstudio.method_configs"]["clod-splatfacto"].partition(":")
    found = getattr(importlib.import_module(module), name)
    assert isinstance(found, MethodSpecification) and found.config.method_name == "clod-splatfacto"


def test_a_dial_is_trained_and_found_by_the_other_commands(run, monkeypatch):
    from nerfstudio.scripts.exporter import ExportGaussianSplat
    from nerfstudio.utils.eval_utils import eval_setup
    from nerfstudio.viewer.utils import parse_object
    from nerfstudio.viewer.viewer_elements import ViewerElement

    model = run.trainer.pipeline.model
    assert model.num_points == N and set(run.trainer.optimizers.optimizers) == {
        "means",
        "scales",
        "quats",
        "features_dc",
        "opacities",
        "log_sigma",
        "growth_d",
    }
    assert not torch.equal(model.means, run.base.means) and torch.equal(
        model.features_rest, run.base.shN
    )
    start = resumed(run, run.folder / "splatfacto", "start").pipeline.model.dial
    assert float((model.dial.log_sigma - start.log_sigma).abs().mean()) > 0.05

    written = run.config.get_base_dir() / "config.yml"
    monkeypatch.setenv("CLOD_VIRTUAL_SCALE", "3")
    pipeline = eval_setup(written, test_mode="test")[1]
    assert [
        element.name for _, element in parse_object(pipeline, ViewerElement, "Custom Elements")
    ] == ["Dial s"]
    dataset = pipeline.datamanager.train_dataset
    view = next(
        view
        for view in scenes.ring(8, WIDTH, HEIGHT)
        if view.name == dataset.image_filenames[0].name
    )
    camera = dataset.cameras[:1]
    for dial in (3.0, 1.0):
        pipeline.model.slider.default_value = dial
        image = pipeline.model.get_outputs_for_camera(camera)["rgb"]
        want = render(model.dial.gaussians(), view, dial).image.clamp(0, 1)
        assert float((image - want).abs().max()) < 0.02
        assert pipeline.model.means is pipeline.model.gauss_params["means"]

    # restored afterwards
    monkeypatch.setattr(ExportGaussianSplat, "write_ply", ExportGaussianSplat.write_ply)
    ExportGaussianSplat(load_config=written, output_dir=run.folder / "export").main()
    exported, own = load(run.folder / "export" / "splat.ply").gaussians, model.dial.gaussians()
    faint = own.opacity_logits < -5.5373
    assert len(exported) == N - int(faint.sum()) and exported.attenuation == own.attenuation
    for name, value in exported.tensors().items():
        torch.testing.assert_close(
            value, own.tensors()[name][~faint].detach(), rtol=1e-6, atol=1e-6
        )

    trainer = resumed(run, run.config.get_checkpoint_dir(), "again")
    assert trainer._start_step == STEPS and torch.equal(
        trainer.pipeline.model.dial.log_sigma, model.dial.log_sigma
    )
    assert trainer.optimizers.optimizers["log_sigma"].state_dict()["state"][0]["step"] == STEPS


def resumed(run, folder, name):
    """A trainer that starts from this folder's checkpoint."""
    config = configured(run.method, run.folder, folder)
    config.timestamp = name
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def test_without_a_checkpoint_the_command_says_what_it_needs(nerfstudio, tmp_path):
    write_capture(tmp_path)
    config = configured(nerfstudio.method, tmp_path, tmp_path / "none")
    with refused("none: has no checkpoint"):
        config.setup(local_rank=0, world_size=1).setup()
    config.load_dir = None
    with refused("give its folder with --load-dir"):
        config.setup(local_rank=0, world_size=1).setup()
