"""The scene and the base that come with the package."""

from pathlib import Path

from clod_adapter.demo import gallery
from clod_adapter.evaluation.evaluate import evaluate
from clod_adapter.io.checkpoint import load
from clod_adapter.io.scene.load import load_scene


def test_scene_and_base_of_the_package(tmp_path: Path) -> None:
    """The base is trained to its end, and packing it and the photographs cost little."""
    files = [Path(gallery.__file__).with_name(name) for name in ("base.spz", "capture.zip")]
    assert files[0].stat().st_size < 2e6 and sum(path.stat().st_size for path in files) < 3e6
    capture, base = tmp_path / "capture", tmp_path / "base.ply"
    for _ in range(2):  # what exists is left
        gallery.unpack(capture, base)
    scene, checkpoint = load_scene(capture), load(base)
    assert (len(scene.train), len(scene.test), checkpoint.notes, scene.notes) == (70, 10, (), ())
    assert evaluate(checkpoint.gaussians, scene.test[:2], [0])[0].psnr > 30
