import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import OpenEXR
import png
import pytest
import tifffile

from diffdisp import image
from diffdisp.color import decode_srgb, encode_srgb
from diffdisp.image import (
    Picture,
    check_output,
    linear_rgb,
    read_mask,
    read_picture,
    write_picture,
)

TARGETS = Path(__file__).parents[1] / "fixtures" / "targets"
SUFFIXES = [".npz", ".png", ".tiff", ".tif", ".exr"]
EXACT = [".npz", ".tiff", ".tif", ".exr", ".NPZ"]


def picture(channels, wavelengths=None, **known):
    """Noise around 0.5, partly negative and above 1, that float32 holds exactly."""
    values = np.random.default_rng(channels).normal(0.5, 0.6, (4, 5, channels))
    return Picture(values.astype(np.float32), wavelengths, **known)


def same(a, b):
    for name in ("radiance", "wavelengths"):
        one, other = getattr(a, name), getattr(b, name)
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_array_equal(one, other, strict=True)
    assert (a.samples, a.depth, a.seed) == (b.samples, b.depth, b.seed)


@pytest.mark.parametrize("suffix", EXACT)
@pytest.mark.parametrize("known", [{}, {"samples": 16, "depth": 50, "seed": 2**40}])
def test_colour_round_trip(tmp_path, suffix, known):
    path = tmp_path / f"colour{suffix}"
    write_picture(path, picture(3, **known))
    same(read_picture(path), picture(3, **known))


@pytest.mark.parametrize("suffix", EXACT)
@pytest.mark.parametrize(
    "wavelengths", [[0.55], [0.4, 0.7], [0.6, 0.5, 0.4], [1.2, 1 / 3, 0.31, 2.325], np.arange(1, 9)]
)
def test_bands_round_trip(tmp_path, suffix, wavelengths):
    path = tmp_path / f"bands{suffix}"
    original = picture(len(wavelengths), np.array(wavelengths, np.float64), samples=3)
    write_picture(path, original)
    same(read_picture(path), original)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_one_pixel(tmp_path, suffix):
    path = tmp_path / f"one{suffix}"
    write_picture(path, Picture(np.full((1, 1, 3), 1.0)))
    np.testing.assert_array_equal(read_picture(path).radiance, np.ones((1, 1, 3)))


def test_npz_keeps_float64(tmp_path):
    original = Picture(np.random.default_rng(0).random((2, 3, 3)), seed=-1)
    write_picture(tmp_path / "a.npz", original)
    same(read_picture(tmp_path / "a.npz"), original)


@pytest.mark.parametrize("bits", [8, 16])
def test_png_round_trip(tmp_path, bits):
    path = tmp_path / "a.png"
    write_picture(path, picture(3), bits=bits)
    back = read_picture(path).radiance
    # Half of one level of the encoded value.
    np.testing.assert_allclose(
        encode_srgb(back), encode_srgb(picture(3).radiance), atol=0.51 / (2**bits - 1)
    )
    # The pixels of a file do not change when it is written again.
    write_picture(tmp_path / "b.png", Picture(back), bits=bits)
    np.testing.assert_array_equal(read_picture(tmp_path / "b.png").radiance, back)
    assert path.read_bytes()[24] == bits


def test_png16_against_another_decoder(tmp_path):
    write_picture(tmp_path / "a.png", picture(3), bits=16)
    _, _, rows, _ = png.Reader(bytes=(tmp_path / "a.png").read_bytes()).asDirect()
    expected = np.round(encode_srgb(picture(3).radiance) * 65535)
    np.testing.assert_array_equal(np.vstack(list(rows)).reshape(4, 5, 3), expected)


@pytest.mark.parametrize("level", [0, 10, 11, 118, 255])
def test_levels_of_a_png(tmp_path, level):
    iio.imwrite(tmp_path / "a.png", np.full((2, 2, 3), level, np.uint8))
    encoded = level / 255
    # IEC 61966-2-1, spelt out; 11 of 255 is the first level above the knee.
    linear = encoded / 12.92 if level <= 10 else ((encoded + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(read_picture(tmp_path / "a.png").radiance, linear, rtol=1e-13)


def test_bands_to_png_keep_white_white(tmp_path):
    white = Picture(np.ones((2, 3, 16)), np.linspace(0.4, 0.7, 16))
    write_picture(tmp_path / "a.png", white)
    np.testing.assert_array_equal(iio.imread(tmp_path / "a.png"), np.full((2, 3, 3), 255))


def test_target_of_another_renderer():
    target = read_picture(TARGETS / "ball_nbk7.npz")
    raw = np.load(TARGETS / "ball_nbk7.npz")
    np.testing.assert_array_equal(target.radiance, raw["radiance"], strict=True)
    np.testing.assert_allclose(target.wavelengths, 0.4 + 0.3 / 8 * (np.arange(8) + 0.5))
    assert (target.samples, target.depth, target.seed) == (None, None, None)
    film = target.film
    assert (film.width, film.height, film.channels) == (96, 96, 8)


def test_bands_and_png_of_the_same_bench_agree():
    bands = linear_rgb(read_picture(TARGETS / "ball_nbk7.npz"))
    colour = read_picture(TARGETS / "ball_nbk7.png").radiance
    assert colour.shape == (128, 128, 3)
    # Blocks of an eighth of the frame: same bench, other size, bands and noise (0.003), and
    # levels of 1/255, over tiles of 0.1 and 1.
    blocks = [p.reshape(8, len(p) // 8, 8, len(p) // 8, 3).mean((1, 3)) for p in (bands, colour)]
    np.testing.assert_allclose(blocks[0], blocks[1], atol=0.004)


def test_spectral_exr_layout(tmp_path):
    write_picture(tmp_path / "a.exr", picture(2, np.array([0.4, 1.0123456])))
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        assert set(file.channels()) == {"S0.400,000000nm", "S0.1012,345600nm"}
        assert file.header()["spectralLayoutVersion"] == "1.0"
        assert file.header()["emissiveUnits"] == "W.m^-2.sr^-1"


@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_spectral_exr_of_another_program(tmp_path, kind):
    names = {"S0.1000nm": 1.0, "S0.4,5e2nm": 0.45, "S0.500,25nm": 0.50025}
    planes = {name: np.full((2, 3), value, kind) for name, value in names.items()}
    planes["R"] = np.zeros((2, 3), kind)
    OpenEXR.File({}, planes).write(str(tmp_path / "a.exr"))
    back = read_picture(tmp_path / "a.exr")
    np.testing.assert_allclose(back.wavelengths, [0.45, 0.50025, 1.0], rtol=1e-15)
    np.testing.assert_array_equal(back.radiance[0, 0], np.array([0.45, 0.50025, 1], kind))
    assert back.radiance.dtype == np.float32


def test_tiff_of_another_program(tmp_path):
    values = np.random.default_rng(1).random((4, 5, 3))
    planes = np.moveaxis(values, -1, 0)
    tifffile.imwrite(tmp_path / "a.tiff", planes, photometric="rgb", planarconfig="separate")
    tifffile.imwrite(tmp_path / "b.tiff", values, photometric="rgb", byteorder=">")
    for name in ("a.tiff", "b.tiff"):
        same(read_picture(tmp_path / name), Picture(values))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("alpha", [False, True])
def test_grey_png_has_equal_channels(tmp_path, bits, alpha):
    level = 3 * 2 ** (bits - 3)
    pixel = [level, 2**bits - 1] if alpha else [level]
    writer = png.Writer(4, 2, greyscale=True, alpha=alpha, bitdepth=bits)
    with (tmp_path / "a.png").open("wb") as file:
        writer.write(file, [pixel * 4] * 2)
    expected = decode_srgb(np.full((2, 4, 3), level / (2**bits - 1)))
    np.testing.assert_allclose(read_picture(tmp_path / "a.png").radiance, expected, rtol=1e-14)


def test_palette_png(tmp_path):
    writer = png.Writer(2, 1, palette=[(255, 0, 0), (0, 0, 255)], bitdepth=1)
    with (tmp_path / "a.png").open("wb") as file:
        writer.write(file, [[1, 0]])
    np.testing.assert_array_equal(
        read_picture(tmp_path / "a.png").radiance, [[[0, 0, 1], [1, 0, 0]]]
    )


def test_unknown_keys_of_npz_are_ignored(tmp_path):
    unreadable = np.array([{"a": 1}], dtype=object)
    np.savez(tmp_path / "a.npz", radiance=np.ones((2, 2, 3)), other=unreadable)
    assert read_picture(tmp_path / "a.npz").wavelengths is None


def test_whole_numbers_become_float64(tmp_path):
    np.savez(tmp_path / "a.npz", radiance=np.ones((2, 2, 3), int), samples=np.array(16.0))
    back = read_picture(tmp_path / "a.npz")
    assert back.radiance.dtype == np.float64
    assert back.samples == 16


ONES = np.ones((2, 2, 3))
BANDS = np.ones((2, 2, 2))


@pytest.mark.parametrize(
    ("fields", "found"),
    [
        ({"image": ONES}, r"no radiance; found \['image'\]"),
        ({}, "no radiance; found nothing"),
        ({"radiance": ONES[0]}, r"found \(2, 3\)"),
        ({"radiance": ONES[:0]}, r"found \(0, 2, 3\)"),
        ({"radiance": BANDS}, "last axis must be 3"),
        ({"radiance": ONES, "wavelength": [0.4, 0.5]}, r"\(2, 2, 3\) and wavelength \(2,\) disagr"),
        ({"radiance": BANDS[..., :1], "wavelength": 0.4}, r"wavelength \(\) disagree"),
        ({"radiance": BANDS, "wavelength": [[0.4, 0.5]]}, r"wavelength \(1, 2\) disagree"),
        ({"radiance": BANDS, "wavelength": [0.4, -0.5]}, "positive and finite, in µm; found -0.5"),
        ({"radiance": BANDS, "wavelength": [0.0, 0.5]}, "positive and finite, in µm; found 0"),
        ({"radiance": BANDS, "wavelength": [0.4, np.nan]}, "positive and finite, in µm; found nan"),
        ({"radiance": BANDS, "wavelength": [np.inf, 1]}, "positive and finite, in µm; found inf"),
        ({"radiance": BANDS, "wavelength": ["a", "b"]}, "wavelength must be real numbers"),
        ({"radiance": ONES * np.nan}, "12 of 12 values of radiance are not finite"),
        ({"radiance": ONES * np.inf}, "12 of 12 values of radiance are not finite"),
        ({"radiance": ONES * 1j}, "radiance must be real numbers; found complex128"),
        ({"radiance": ONES > 0}, "radiance must be real numbers; found bool"),
        ({"radiance": ONES.astype(object)}, "allow_pickle"),
        ({"radiance": ONES, "samples": 0}, "samples must be at least 1; found 0"),
        ({"radiance": ONES, "depth": [1, 2]}, "depth must be one whole number"),
        ({"radiance": ONES, "seed": 0.5}, "seed must be one whole number"),
        ({"radiance": ONES, "seed": np.inf}, "infinity"),
    ],
)
def test_bad_npz(tmp_path, fields, found):
    path = tmp_path / "bad.npz"
    np.savez(path, **fields)
    with pytest.raises(ValueError, match=found) as caught:
        read_picture(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize(
    "content", [b"", b"hello", b"\x89PNG\r\n\x1a\n", b"PK\x03\x04" + bytes(99)]
)
def test_no_picture(tmp_path, suffix, content):
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"cannot be read as a {suffix} picture: .") as caught:
        read_picture(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_cut_off_file(tmp_path, suffix):
    path = tmp_path / f"cut{suffix}"
    write_picture(path, Picture(np.random.default_rng(0).random((64, 64, 3))))
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(ValueError, match=f"cut{suffix}: cannot be read"):
        read_picture(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_missing_file(tmp_path, suffix):
    with pytest.raises(ValueError, match="there is no such file"):
        read_picture(tmp_path / f"none{suffix}")
    (tmp_path / f"folder{suffix}").mkdir()
    with pytest.raises(ValueError, match="there is no such file"):
        read_picture(tmp_path / f"folder{suffix}")


@pytest.mark.parametrize("bits", [8, 16])
def test_transparent_png_is_refused(tmp_path, bits):
    writer = png.Writer(1, 1, greyscale=False, alpha=True, bitdepth=bits)
    with (tmp_path / "a.png").open("wb") as file:
        writer.write(file, [[1, 2, 3, 2**bits - 2]])
    with pytest.raises(ValueError, match=r"a\.png.*transparent"):
        read_picture(tmp_path / "a.png")


@pytest.mark.parametrize(("alpha", "fault"), [(1.0, None), (0.5, "transparent")])
def test_alpha_of_exr(tmp_path, alpha, fault):
    planes = {name: np.full((2, 3), i, np.float32) for i, name in enumerate("RGB")}
    planes["A"] = np.full((2, 3), alpha, np.float32)
    OpenEXR.File({}, planes).write(str(tmp_path / "a.exr"))
    if fault is None:
        np.testing.assert_array_equal(read_picture(tmp_path / "a.exr").radiance[0, 0], [0, 1, 2])
    else:
        with pytest.raises(ValueError, match=fault):
            read_picture(tmp_path / "a.exr")


def test_exr_without_colour_or_bands(tmp_path):
    OpenEXR.File({}, {"Z": np.ones((2, 3), np.float32)}).write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match=r"found \['Z'\]"):
        read_picture(tmp_path / "a.exr")


def test_detail_of_an_exr(tmp_path):
    window = (np.array([0, 0], np.int32), np.array([9, 9], np.int32))
    planes = {name: np.ones((2, 3), np.float32) for name in "RGB"}
    OpenEXR.File({"displayWindow": window}, planes).write(str(tmp_path / "a.exr"))
    with pytest.raises(ValueError, match="detail of a larger picture"):
        read_picture(tmp_path / "a.exr")


@pytest.mark.parametrize(
    ("values", "found"),
    [
        (np.ones((4, 5, 3), np.uint8), "floating-point; found uint8"),
        (np.ones((4, 5), np.float32), r"found \(4, 5\)"),
        (np.full((4, 5, 3), np.nan, np.float32), "60 of 60 values"),
    ],
)
def test_bad_tiff(tmp_path, values, found):
    photometric = "rgb" if values.ndim == 3 else "minisblack"
    tifffile.imwrite(tmp_path / "a.tiff", values, photometric=photometric)
    with pytest.raises(ValueError, match=found):
        read_picture(tmp_path / "a.tiff")


def test_pages_of_a_tiff_are_no_bands(tmp_path):
    tifffile.imwrite(tmp_path / "a.tiff", np.ones((6, 4, 5), np.float32), photometric="minisblack")
    with pytest.raises(ValueError, match="6 pages, not one"):
        read_picture(tmp_path / "a.tiff")


def test_description_of_a_tiff(tmp_path):
    wavelengths = np.array([0.4, 1 / 3])
    write_picture(tmp_path / "a.tiff", picture(2, wavelengths, samples=4, depth=5, seed=6))
    with tifffile.TiffFile(tmp_path / "a.tiff") as file:
        found = json.loads(file.pages[0].description)
    assert found == {"wavelength": wavelengths.tolist(), "samples": 4, "depth": 5, "seed": 6}


@pytest.mark.parametrize("name", ["a.jpg", "a", "a.npy", ".png"])
@pytest.mark.parametrize(
    "call", [check_output, read_picture, lambda p: write_picture(p, picture(3))]
)
def test_unknown_suffix(tmp_path, name, call):
    with pytest.raises(ValueError, match=r"one of \.npz, \.png, \.tif, \.tiff, \.exr; found"):
        call(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "wavelengths", "bits", "found"),
    [
        ("none/a.png", None, 8, "there is no folder"),
        ("folder.png", None, 8, "is a folder"),
        ("a.png", [0.4, 0.9], 8, r"380-780 nm only; found 400 to 900 nm; \.npz"),
        ("a.exr", [0.4, 0.4 + 1e-13], 8, "at least 1e-6 nm apart"),
        ("a.png", None, 12, "12 bits"),
        ("a.exr", None, 16, "16 bits"),
    ],
)
def test_bad_output_is_found_before_the_render(tmp_path, name, wavelengths, bits, found):
    (tmp_path / "folder.png").mkdir()
    bands = None if wavelengths is None else np.array(wavelengths)
    with pytest.raises(ValueError, match=found):
        check_output(tmp_path / name, bands, bits=bits)
    with pytest.raises(ValueError, match=found):
        write_picture(tmp_path / name, picture(2 if bands is not None else 3, bands), bits=bits)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.png"]


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_locked_folder(tmp_path):
    tmp_path.chmod(0o555)
    with pytest.raises(ValueError, match="may not be written to"):
        check_output(tmp_path / "a.png")


@pytest.mark.parametrize(
    ("module", "package", "name", "bits"),
    [
        ("tifffile", "tifffile", "a.tiff", 8),
        ("OpenEXR", "OpenEXR", "a.exr", 8),
        ("png", "pypng", "a.png", 16),
    ],
)
def test_missing_extra_is_named(tmp_path, monkeypatch, module, package, name, bits):
    path = tmp_path / name
    write_picture(path, picture(3), bits=bits)
    monkeypatch.setitem(sys.modules, module, None)
    message = rf"needs the package {package}: pip install 'diffdisp\[io\]'"
    with pytest.raises(ImportError, match=message):
        check_output(path, bits=bits)
    with pytest.raises(ImportError, match=message):
        write_picture(path, picture(3), bits=bits)
    with pytest.raises(ImportError, match=message):
        read_picture(path)


def test_formats_of_the_core_need_no_extra(tmp_path, monkeypatch):
    for module in ("tifffile", "OpenEXR", "png"):
        monkeypatch.setitem(sys.modules, module, None)
    for name in ("a.png", "a.npz"):
        write_picture(tmp_path / name, picture(3))
        read_picture(tmp_path / name)


def test_nan_is_no_colour(tmp_path):
    broken = Picture(np.full((2, 2, 3), np.nan))
    with pytest.raises(ValueError, match="not finite everywhere"):
        write_picture(tmp_path / "a.png", broken)
    assert list(tmp_path.iterdir()) == []
    # Kept where it can be: the fault of a long render is worth a look.
    write_picture(tmp_path / "a.npz", broken)
    assert np.isnan(np.load(tmp_path / "a.npz")["radiance"]).all()


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("failure", [OSError, KeyboardInterrupt])
def test_interrupted_before_the_renaming(tmp_path, monkeypatch, suffix, failure):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"old")

    def interrupted(self, target):
        assert self.stat().st_size > 0
        assert self.suffix == suffix
        raise failure

    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(failure):
        write_picture(path, picture(3))
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_interrupted_half_way(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    path.write_bytes(b"old")

    def full_disk(beside, picture, bits):
        beside.write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(image, "_write_png", full_disk)
    with pytest.raises(OSError, match="No space left"):
        write_picture(path, picture(3))
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_written_over_and_nothing_left(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(b"old")
    plain = tmp_path / "plain"
    plain.touch()
    write_picture(path, Picture(ONES))
    np.testing.assert_array_equal(read_picture(path).radiance, ONES)
    assert set(tmp_path.iterdir()) == {path, plain}
    # As readable for others as any new file.
    assert path.stat().st_mode == plain.stat().st_mode


def test_a_link_stays_a_link(tmp_path):
    (tmp_path / "link.npz").symlink_to(tmp_path / "real.data")
    write_picture(tmp_path / "link.npz", Picture(ONES))
    assert (tmp_path / "link.npz").is_symlink()
    assert (tmp_path / "real.data").is_file()


@pytest.mark.parametrize(
    ("radiance", "wavelengths"),
    [(ONES[0], None), (BANDS, None), (BANDS, np.ones(3)), (BANDS, np.array([0.0, 1.0]))],
)
def test_parts_of_a_picture_must_agree(radiance, wavelengths):
    with pytest.raises(ValueError, match=r"radiance|wavelength"):
        Picture(radiance, wavelengths)


@pytest.mark.parametrize("name", ["m.npz", "n.npz", "m.png", "m.tiff", "m.exr", "n.tiff"])
def test_a_mask_is_what_is_not_zero(tmp_path, name):
    marked = np.zeros((3, 4), bool)
    marked[1, 2] = marked[2, 0] = True
    path, shown = tmp_path / name, marked[..., None] * np.float32([0.0, 1.0, 0.5])
    if name == "n.npz":
        np.savez(path, mask=marked)
    elif name == "n.tiff":
        tifffile.imwrite(path, marked.astype(np.uint8) * 255)
    else:
        write_picture(path, Picture(shown))
    found = read_mask(path)
    assert found.dtype == bool
    np.testing.assert_array_equal(found, marked)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"other": np.ones((2, 2))}, "it has no mask"),
        ({"mask": np.ones(3)}, r"must be \(height, width\)"),
        ({"mask": np.ones((0, 3))}, r"must be \(height, width\)"),
        ({"mask": np.full((2, 2), np.nan)}, "finite numbers"),
        ({"mask": np.full((2, 2), "white")}, "finite numbers"),
    ],
)
def test_what_is_no_mask(tmp_path, fields, words):
    np.savez(tmp_path / "m.npz", **fields)
    with pytest.raises(ValueError, match=words):
        read_mask(tmp_path / "m.npz")


@pytest.mark.parametrize("bits", [8, 16])
def test_a_png_tells_where_it_was_cut_off(tmp_path, bits):
    top = 2**bits - 1
    # What is just above is rounded to the top code, what is just below to the one beneath.
    edges = decode_srgb((top - np.array([0.49, 0.51, 0.0])) / top)
    write_picture(tmp_path / "a.png", Picture(edges[None, None]), bits=bits)
    read = read_picture(tmp_path / "a.png")
    np.testing.assert_array_equal(read.radiance[0, 0] >= read.ceiling, [True, False, True])
    np.testing.assert_allclose(read.ceiling, (edges[0] + edges[1]) / 2, rtol=1e-6)


def test_other_formats_have_no_ceiling(tmp_path):
    for suffix in EXACT:
        path = tmp_path / f"a{suffix}"
        write_picture(path, replace(picture(3), ceiling=0.5))
        assert read_picture(path).ceiling is None


@pytest.mark.parametrize("ceiling", [0.0, -1.0, np.nan, np.inf])
def test_a_ceiling_that_is_none(ceiling):
    with pytest.raises(ValueError, match="ceiling must be positive and finite"):
        replace(picture(3), ceiling=ceiling)
