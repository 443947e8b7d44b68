"""The wrappers against stand-ins with the signatures of gsplat 1.4.0 to 1.6.0."""

import inspect

import pytest
import torch
from refusals import refused
from torch import Tensor

import gsplat_versions
from backends import fresh_copy
from clod_adapter.config import AttenuationConfig
from gsplat_versions import FUNCTIONS
from scenes import seeded

N = 5
WIDTH = 20
HEIGHT = 12
CAMERAS = 3
VERSIONS = gsplat_versions.signatures()
WHOLE = AttenuationConfig()
OF_SCENE = {
    "means": (N, 3),
    "quats": (N, 4),
    "scales": (N, 3),
    "opacities": (N,),
    "covars": (N, 3, 3),
}
OF_CAMERA = {
    "viewmats": (4, 4),
    "Ks": (3, 3),
    "backgrounds": (3,),
    "viewmats_rs": (4, 4),
    "radial_coeffs": (6,),
    "tangential_coeffs": (2,),
    "thin_prism_coeffs": (4,),
    "rays": (HEIGHT, WIDTH, 6),
    "colors": (N, 3),
    "extra_signals": (N, 3),
}


class Gsplat:
    """A version's stand-in, whose images have the number of the call, and our module on top of
    it.
    """

    def __init__(self, monkeypatch, version):
        self.calls = []
        self.meta = {}
        self.installed = gsplat_versions.module(version, self.draw)
        self.ours = fresh_copy(monkeypatch, "gsplat", "gsplat", self.installed)

    def draw(self, name, version, given):
        self.calls.append(given)
        image = torch.full((1, HEIGHT, WIDTH, 3), float(len(self.calls)))
        if name == "rasterization_inria_wrapper":
            return image if version == "1.4.0" else image[0], None, {}
        if name == "rasterization_2dgs_inria_wrapper":
            return (image, image[..., :1]), self.meta
        surfaces = (image, image[0], image, image) if name == "rasterization_2dgs" else ()
        return image, image[..., :1], *surfaces, self.meta

    def arguments(self, name, cameras=CAMERAS):
        """Every tensor that a function takes, random; of cameras the position and the principal
        point.
        """
        generator = seeded(0)
        shapes = OF_SCENE | {key: (cameras, *shape) for key, shape in OF_CAMERA.items()}
        given = {key: 0.1 + torch.rand(shape, generator=generator) for key, shape in shapes.items()}
        for key, size in {"viewmats": 4, "Ks": 3}.items():
            given[key][..., :-1], given[key][..., -1, -1] = torch.eye(size)[:, :-1], 1
        given |= {"width": WIDTH, "height": HEIGHT}
        taken = inspect.signature(getattr(self.installed, name)).parameters
        return {key: value for key, value in given.items() if key in taken}


@pytest.mark.parametrize("version", VERSIONS)
def test_signatures_are_the_installed_ones_and_four(monkeypatch, version):
    gsplat = Gsplat(monkeypatch, version)
    assert sorted(gsplat.ours.__all__) == sorted(FUNCTIONS)
    for name in FUNCTIONS:
        ours = inspect.signature(getattr(gsplat.ours, name)).parameters
        theirs = inspect.signature(getattr(gsplat.installed, name)).parameters
        four = ("sigma_d", "virtual_scale", "attenuation", "growth_d")
        assert {key: p for key, p in ours.items() if key not in four} == dict(theirs)
        assert all(ours[key].kind is inspect.Parameter.KEYWORD_ONLY for key in four)


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("version", VERSIONS)
def test_a_camera_is_a_call_with_its_part_of_every_argument(monkeypatch, version, name):
    """Images are joined, where gsplat returns those of all cameras or refuses several."""
    gsplat = Gsplat(monkeypatch, version)
    given = gsplat.arguments(name)
    dial = {"sigma_d": torch.full((N,), 1e9), "attenuation": WHOLE}
    found = getattr(gsplat.ours, name)(**given, **dial)
    for k, call in enumerate(gsplat.calls):
        for key, value in given.items():
            if isinstance(value, Tensor):
                want = value[k][None] if key in OF_CAMERA else value
                torch.testing.assert_close(call[key], want, rtol=1e-5, atol=1e-6)
    image = found[0][0] if isinstance(found[0], tuple) else found[0]
    assert image.shape == (CAMERAS, HEIGHT, WIDTH, 3)
    assert image[:, 0, 0, 0].tolist() == [1 + k for k in range(CAMERAS)]
    harmonics = torch.rand(N, 4, 3)
    getattr(gsplat.ours, name)(**given | {"colors": harmonics, "sh_degree": 1}, **dial)
    assert torch.equal(gsplat.calls[-1]["colors"], harmonics)
    if "rays" in given:  # the only argument that gsplat broadcasts
        ray = given["rays"][:1]
        gsplat.ours.rasterization(**given | {"rays": ray, "colors": None}, **dial)
        assert torch.equal(gsplat.calls[-1]["rays"], ray)


def test_meta_of_several_cameras_is_a_list(monkeypatch):
    gsplat = Gsplat(monkeypatch, "1.6.0")
    for name in ("rasterization", "rasterization_2dgs", "rasterization_2dgs_inria_wrapper"):
        for cameras in (1, CAMERAS):
            given = gsplat.arguments(name, cameras=cameras)
            meta = getattr(gsplat.ours, name)(**given, sigma_d=torch.ones(N), packed=True)[-1]
            if cameras == 1:
                assert meta is gsplat.meta
            else:
                assert [id(each) for each in meta] == CAMERAS * [id(gsplat.meta)]
    assert gsplat.calls[-1]["kwargs"] == {"packed": True}


@pytest.mark.parametrize(
    ("version", "name"), [("1.4.0", "rasterization"), *(("1.5.3", name) for name in FUNCTIONS)]
)
def test_culled_rows_are_culled_by_the_projection(monkeypatch, version, name):
    """By their opacity where the projection has it as an argument, else by a centre behind the
    camera.
    """
    gsplat = Gsplat(monkeypatch, version)
    given = gsplat.arguments(name, cameras=1) | {"viewmats": torch.eye(4)[None]}
    sigma_d = torch.tensor([1e9, 1e-6, 1e9, 1e-6, 1e9])
    getattr(gsplat.ours, name)(**given, sigma_d=sigma_d, virtual_scale=3.0, attenuation=WHOLE)
    culled, passed = sigma_d < 1, gsplat.calls[0]
    assert torch.equal(passed["opacities"] == 0, culled)
    assert torch.equal(passed["means"][~culled], given["means"][~culled])
    if name == "rasterization" and version != "1.4.0":
        assert passed["means"] is given["means"]
    else:
        assert passed["means"][culled, 2].tolist() == [-1, -1]


def test_bad_arguments_are_refused(monkeypatch):
    gsplat = Gsplat(monkeypatch, "1.4.0")
    given, sigma_d = gsplat.arguments("rasterization_inria_wrapper"), torch.ones(N)
    with pytest.raises(TypeError, match="unexpected keyword argument 'with_ut'"):
        gsplat.ours.rasterization(**given, with_ut=True, sigma_d=sigma_d)
    with refused("masks may differ between cameras"):
        gsplat.ours.rasterization_inria_wrapper(**given, masks=torch.ones(2), sigma_d=sigma_d)
    gsplat = Gsplat(monkeypatch, "1.5.3")
    given = gsplat.arguments("rasterization") | {"sigma_d": sigma_d}
    for changed, message in (
        ({"distributed": True}, "distributed=True shares one opacity"),
        ({"sigma_d": sigma_d[1:]}, r"sigma_d is \(4,\) and opacities \(5,\)"),
        ({"growth_d": sigma_d[1:], "attenuation": WHOLE}, r"growth_d is \(4,\) and"),
        ({"viewmats": given["viewmats"][None]}, "of several scenes, .* one scene at a time"),
    ):
        with refused(message):
            gsplat.ours.rasterization(**given | changed)
    with pytest.raises(ImportError, match="pip install gsplat==1.5.3"):
        fresh_copy(monkeypatch, "gsplat", "gsplat", None)
