import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image
from refusals import refused

from clod_adapter.io.scene import images
from clod_adapter.io.scene.images import image_size, read_image
from photographs import pixels

GREY = pixels(0)[..., 0]


def read(path, width=40, height=30):
    image, notes = read_image(path, width, height, 1600)
    assert image.mode == "RGB"
    return np.asarray(image), [what for what, _ in notes]


ALPHA = np.where(GREY > 99, 255, 0).astype(np.uint8)
DEEP = np.random.default_rng(0).integers(0, 65536, (30, 40), dtype=np.uint16)
DEEP[0, :3] = 0, 65535, 128  # the ends, and the last value that is nearest to black
FLAT = np.full((30, 40, 3), 99, np.uint8)
OVER_BLACK = ["have transparency: laid over black"]
CASES = (
    (Image.fromarray(GREY), "PNG", {}, GREY, []),
    (Image.fromarray(GREY).convert("P"), "PNG", {}, GREY, []),
    (Image.fromarray(GREY > 99), "PNG", {}, ALPHA, []),
    # Grey of 16 bits to the nearest level; Pillow reads such colours itself.
    (Image.fromarray(DEEP), "PNG", {}, np.rint(DEEP / 257), []),
    (Image.fromarray(DEEP), "TIFF", {}, np.rint(DEEP / 257), []),
    (
        Image.fromarray(np.dstack([pixels(0), ALPHA])),
        "PNG",
        {},
        pixels(0) * (ALPHA[..., None] > 0),
        OVER_BLACK,
    ),
    (Image.fromarray(np.dstack([pixels(0), np.full_like(GREY, 255)])), "PNG", {}, pixels(0), []),
    (Image.fromarray(GREY), "PNG", {"transparency": 99}, np.where(GREY == 99, 0, GREY), OVER_BLACK),
    # A JPEG with further pictures, as phones write.
    (
        Image.fromarray(FLAT),
        "MPO",
        {"save_all": True, "append_images": [Image.fromarray(FLAT)]},
        FLAT,
        [],
    ),
    *((Image.fromarray(FLAT), kind, {}, FLAT, []) for kind in ("TIFF", "WEBP", "BMP")),
)


def test_kinds_of_image(tmp_path):
    """The content decides, whatever the name."""
    for image, kind, options, want, noted in CASES:
        image.save(tmp_path / "a.jpg", kind, **options)
        got, notes = read(tmp_path / "a.jpg")
        error = np.abs(got - (want if want.ndim == 3 else want[..., None]).astype(float))
        assert error.max() <= (kind in ("MPO", "WEBP")) and notes == noted, (image.mode, kind)


def test_separate_planes_and_32_bits_are_refused(tmp_path):
    for kind in (np.float32, np.int32):
        Image.fromarray(GREY.astype(kind)).save(tmp_path / "a.tif")
        with refused("a.tif: has 32 bits per channel"):
            read(tmp_path / "a.tif")
    tifffile = pytest.importorskip("tifffile")
    planes = np.moveaxis(pixels(0), 2, 0).astype(np.uint16) * 257
    tifffile.imwrite(tmp_path / "a.tif", planes, photometric="rgb", planarconfig="separate")
    with refused("a.tif: has more than 8 bits in planes"):
        read(tmp_path / "a.tif")


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_exif_rotation_is_applied_if_the_camera_has_the_rotated_shape(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels(0)).save(tmp_path / "a.png", exif=exif)
    as_it_is, notes = read(tmp_path / "a.png")
    assert_array_equal(as_it_is, pixels(0))  # as COLMAP reads it
    assert notes == []
    turned, notes = read(tmp_path / "a.png", 300, 400)
    # what is at the top left once turned
    a, b = {5: (0, 0), 6: (-1, 0), 7: (-1, -1), 8: (0, -1)}[orientation]
    assert_array_equal(turned[0, 0], pixels(0)[a, b])
    assert turned.shape == (40, 30, 3)
    assert notes == ["rotated by their EXIF orientation, as the cameras are"]


@pytest.mark.parametrize("name", ["a.jpg", "a.png", "a.tif", "a.webp", "a.heic", "absent.png"])
def test_what_cannot_be_decoded_is_refused(tmp_path, name):
    path, message = tmp_path / name, f"{name}: cannot be decoded"
    if name == "a.heic":
        path.write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
        message += ", is HEIC; export it as JPEG or PNG"
    elif name == "absent.png":
        message = f"{name}: cannot be read .No such file"
    else:
        Image.fromarray(pixels(0)).save(path)
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    with refused(message):
        read(path)
    if name == "a.heic":
        with refused(message):
            image_size(path)


def reduced(path, monkeypatch, width, height, max_width):
    monkeypatch.setattr(images, "LARGE", 1000)
    image, notes = read_image(path, width, height, max_width)
    assert len(notes) == len(set(notes))
    assert sum("takes long: reduced first" in what for what, _ in notes) == 1
    return np.asarray(image).astype(float)


@pytest.mark.parametrize("kind", ["RGB", "L", "RGBA", "P", "I;16", "CMYK"])
def test_large_image_is_reduced_to_block_means(tmp_path, monkeypatch, kind):
    """Reduced by 3, so that it is at least twice as wide as what is made of it."""
    width, height = 200, 262
    rgb = pixels(3, width, height)
    image = Image.fromarray(rgb)
    if kind == "RGBA":
        image.putalpha(Image.fromarray(rgb[..., 0]))
    elif kind == "I;16":
        image = Image.fromarray(rgb[..., 0].astype(np.uint16) * 257)
    else:
        image = image.convert(kind)
    path = tmp_path / ("a.tif" if kind == "CMYK" else "a.png")
    image.save(path)
    whole = read(path, width, height)[0].astype(float)
    got = reduced(path, monkeypatch, width, height, 33)
    assert got.shape == (-(-height // 3), -(-width // 3), 3)
    want = (
        whole[: height // 3 * 3, : width // 3 * 3]
        .reshape(height // 3, 3, width // 3, 3, 3)
        .mean((1, 3))
    )
    assert np.abs(got[: height // 3, : width // 3] - want).max() <= 1


def test_large_jpeg_is_reduced_while_decoding(tmp_path, monkeypatch):
    ramp = np.linspace(0, 255, 400 * 300).reshape(300, 400).astype(np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(ramp).convert("RGB").save(tmp_path / "a.jpg", quality=95, exif=exif)
    whole = read(tmp_path / "a.jpg", 300, 400)[0].astype(float)
    got = reduced(tmp_path / "a.jpg", monkeypatch, 300, 400, 30)  # by 4, as the decoder has no 5
    assert got.shape == (100, 75, 3)
    assert np.abs(got - whole.reshape(100, 4, 75, 4, 3).mean((1, 3))).max() < 4


def test_wrong_shape_is_refused(tmp_path):
    Image.fromarray(GREY).save(tmp_path / "a.png")
    for height in (30, 40):  # a turned one, too, as there is no EXIF
        with refused(f"a.png: is 40x30, its camera 30x{height}, another shape"):
            read(tmp_path / "a.png", 30, height)
