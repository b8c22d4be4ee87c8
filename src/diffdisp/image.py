"""Pictures in and out: .npz, .png, .tiff, .exr."""

import contextlib
import dataclasses
import importlib
import json
import os
import re
import secrets
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
from jaxtyping import Bool, Float

from diffdisp.color import bands_to_rgb, check_visible, decode_srgb, encode_srgb
from diffdisp.film import Film

EXTRA_PACKAGES = {
    "tifffile": "tifffile",
    "OpenEXR": "OpenEXR",
    "png": "pypng",
}
"""Module → package, of what the extra `io` installs."""

SUFFIX_MODULES = {
    ".npz": None,
    ".png": None,
    ".tif": "tifffile",
    ".tiff": "tifffile",
    ".exr": "OpenEXR",
}
"""Suffix of a picture → the module of `EXTRA_PACKAGES` that it takes."""

COUNTS = ("samples", "depth", "seed")
"""The whole numbers a picture may carry."""

EXR_BAND = re.compile(r"S0\.(?P<nm>\d+(,\d*)?([eE][+-]?\d+)?)nm")
"""Channel of an unpolarised emissive band, a comma for the decimal point (a point would divide
layers). Source: Fichet, Pacanowski and Wilkie, An OpenEXR Layout for Spectral Images (JCGT 10(3),
2021)."""
EXR_ATTRIBUTES = {"spectralLayoutVersion": "1.0", "emissiveUnits": "W.m^-2.sr^-1"}
"""What marks a spectral file. Source: as `EXR_BAND`."""

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""How each PNG begins. Source: W3C, Portable Network Graphics (2nd edition), section 5.2."""
PNG_DEPTH_AT = 24
"""Which byte of a PNG is its bit depth. Source: as `PNG_SIGNATURE`, section 11.2.2 (IHDR)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Picture:
    """A picture and what is known of how it was made.

    Args:
        radiance: (height, width, channels), row 0 on top; a channel per wavelength, or linear
            sRGB.
        wavelengths: (channels,) µm in air; None for linear sRGB.
        samples: samples per pixel, if known.
        depth: most segments of a path, if known.
        seed: seed of the random numbers, if known.
        ceiling: where values were cut off: one of at least this says no more than that the
            radiance is at least this. None: nowhere. A .png tells it; no file keeps it.

    Raises:
        ValueError: radiance of other than three axes, of no pixels, or whose last axis disagrees
            with the wavelengths; wavelengths or a ceiling that are not finite and positive.
    """

    # The shapes are checked below, always and in words: they come from files.
    radiance: Float[np.ndarray, "..."]
    wavelengths: Float[np.ndarray, "..."] | None = None
    samples: int | None = None
    depth: int | None = None
    seed: int | None = None
    ceiling: float | None = None

    def __post_init__(self) -> None:
        """Refuse arrays that do not belong together."""
        shape = self.radiance.shape
        if len(shape) != 3 or 0 in shape:
            raise ValueError(f"radiance must be (height, width, channels); found {shape}")
        if self.ceiling is not None and not (np.isfinite(self.ceiling) and self.ceiling > 0):
            raise ValueError(f"ceiling must be positive and finite; found {self.ceiling:g}")
        if self.wavelengths is None:
            if shape[2] != 3:
                raise ValueError(
                    f"radiance {shape} without wavelength is linear sRGB: its last axis must be 3"
                )
            return
        if self.wavelengths.shape != shape[2:]:
            raise ValueError(
                f"radiance {shape} and wavelength {self.wavelengths.shape} disagree: "
                "radiance needs one value per wavelength on its last axis"
            )
        wrong = self.wavelengths[~(np.isfinite(self.wavelengths) & (self.wavelengths > 0))]
        if len(wrong):
            raise ValueError(f"wavelength must be positive and finite, in µm; found {wrong[0]:g}")

    @property
    def film(self) -> Film:
        """The film that such a picture is taken on."""
        height, width, _ = self.radiance.shape
        return Film(width, height, self.wavelengths)


def linear_rgb(picture: Picture) -> Float[np.ndarray, "height width 3"]:
    """The picture in linear sRGB.

    Args:
        picture: in colour, or in bands within 380-780 nm.

    Raises:
        ValueError: bands outside 380-780 nm.
    """
    if picture.wavelengths is None:
        return picture.radiance
    return bands_to_rgb(picture.radiance, picture.wavelengths)


def check_output(
    path: str | Path,
    wavelengths: Float[np.ndarray, " k"] | None = None,
    *,
    bits: int = 8,
) -> None:
    """Raise now what `write_picture` would raise after a long render.

    Args:
        path: where the picture will go.
        wavelengths: its bands, µm; None for colour.
        bits: as in `write_picture`.

    Raises:
        ValueError: a suffix, a depth or bands that cannot be written; a folder that does not
            exist or may not be written to.
        ImportError: a package that the format takes is not installed.
    """
    suffix = _suffix(path)
    if bits not in (8, 16) or (bits == 16 and suffix != ".png"):
        raise ValueError(f"{path}: {bits} bits: a .png has 8 or 16; leave it at 8 elsewhere")
    _extra_module("png" if bits == 16 else SUFFIX_MODULES[suffix], path)
    folder = Path(path).parent
    if not folder.is_dir():
        raise ValueError(f"{path}: there is no folder {folder}")
    if Path(path).is_dir():
        raise ValueError(f"{path}: is a folder")
    if not os.access(folder, os.W_OK):
        raise ValueError(f"{path}: the folder {folder} may not be written to")
    if wavelengths is not None and suffix == ".png":
        try:
            check_visible(wavelengths)
        except ValueError as error:
            raise ValueError(f"{path}: {error}; .npz, .tiff and .exr keep bands") from error
    if wavelengths is not None and suffix == ".exr":
        names = _exr_bands(wavelengths)
        if len(set(names)) < len(names):
            raise ValueError(f"{path}: .exr needs bands at least 1e-6 nm apart: {names}")


def write_picture(path: str | Path, picture: Picture, *, bits: int = 8) -> None:
    """Write a picture in the format of the path's suffix.

    It is written beside and renamed: a failure on the way leaves an older file whole. `.npz` holds
    everything; `.tiff` and `.exr` the same with radiance in float32; `.png` only sRGB clipped to
    0..1 and rounded.

    Args:
        path: .npz, .png, .tiff, .tif or .exr.
        picture: what to write.
        bits: 8 or, for .png, 16 per channel.

    Raises:
        ValueError: as `check_output`; values that are not finite, to .png.
        ImportError: as `check_output`.
    """
    check_output(path, picture.wavelengths, bits=bits)
    with replacing(path) as beside:
        match _suffix(path):
            case ".npz":
                np.savez_compressed(beside, **_fields(picture), allow_pickle=False)
            case ".png":
                _write_png(beside, picture, bits)
            case ".exr":
                _write_exr(beside, picture)
            case _:
                _write_tiff(beside, picture)


def read_picture(path: str | Path) -> Picture:
    """Read a picture in the format of the path's suffix.

    `.npz` files hold `radiance` (H, W, K or 3), row 0 on top, and `wavelength` (K,) in µm, absent
    for linear sRGB; optionally `samples`, `depth` and `seed`; other keys are ignored. The values
    of a `.png` are decoded to linear sRGB, and its `ceiling` is told. Negative radiance is legal:
    noise has it.

    Args:
        path: .npz, .png, .tiff, .tif or .exr.

    Returns:
        Float64 where the file has it or where its values are whole numbers, else float32.

    Raises:
        ValueError: the file is missing, no such picture, transparent, not finite, or its parts
            disagree; the message names the file and what was found.
        ImportError: a package that the format takes is not installed.
    """
    with _readable(path) as suffix:
        match suffix:
            case ".npz":
                fields = _read_npz(Path(path))
            case ".png":
                fields = _read_png(Path(path))
            case ".exr":
                fields = _read_exr(Path(path))
            case _:
                fields = _read_tiff(Path(path))
        return _picture(fields)


@contextlib.contextmanager
def _readable(path: str | Path) -> Iterator[str]:
    """The suffix of a picture; what goes wrong while it is read is told of the file."""
    suffix = _suffix(path)
    _extra_module(SUFFIX_MODULES[suffix], path)
    if not Path(path).is_file():
        raise ValueError(f"{path}: there is no such file")
    try:
        yield suffix
    except ImportError:
        raise
    # Each decoder has its own kinds of error for a damaged file, some of them undocumented.
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise ValueError(f"{path}: cannot be read as a {suffix} picture: {reason}") from error


def read_mask(path: str | Path) -> Bool[np.ndarray, "height width"]:
    """Read which pixels a picture marks: those with a channel that is not zero.

    Args:
        path: .npz with `mask` (height, width), or any picture that `read_picture` reads; a .tiff of
            whole numbers too.

    Raises:
        ValueError: as `read_picture`.
        ImportError: as `read_picture`.
    """
    with _readable(path) as suffix:
        match suffix:
            case ".npz":
                fields = _read_npz(Path(path), "mask")
            case ".png":
                fields = _read_png(Path(path))
            case ".exr":
                fields = _read_exr(Path(path))
            case _:
                fields = _tiff_fields(Path(path))
        values = np.asarray(fields.get("mask", fields.get("radiance")))
        if values.dtype.kind not in "fiub" or not np.isfinite(values).all():
            raise ValueError(f"a mask must be finite numbers; found {values.dtype}")
        marked = values != 0
        marked = np.any(marked, axis=-1) if marked.ndim == 3 else marked
        if marked.ndim != 2 or 0 in marked.shape:
            raise ValueError(f"a mask must be (height, width); found {values.shape}")
        return marked


def _picture(fields: Mapping[str, Any]) -> Picture:
    """The picture in the keys of a .npz file."""
    radiance = _reals(fields, "radiance")
    broken = np.count_nonzero(~np.isfinite(radiance))
    if broken:
        raise ValueError(f"{broken} of {radiance.size} values of radiance are not finite")
    wavelengths = None
    if "wavelength" in fields:
        wavelengths = _reals(fields, "wavelength").astype(np.float64)
    counts = {name: _whole(fields[name], name) for name in COUNTS if name in fields}
    return Picture(radiance, wavelengths, ceiling=fields.get("ceiling"), **counts)


def _fields(picture: Picture) -> dict[str, Any]:
    """The picture as the keys of a .npz file; what is not known is left out."""
    fields = {"radiance": picture.radiance, "wavelength": picture.wavelengths}
    counts = {name: getattr(picture, name) for name in COUNTS}
    return {name: value for name, value in {**fields, **counts}.items() if value is not None}


def _reals(fields: Mapping[str, Any], name: str) -> np.ndarray:
    """One field as float32 or float64, in the machine's byte order."""
    array = np.asarray(fields[name])
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name} must be real numbers; found {array.dtype}")
    small = array.dtype.kind == "f" and array.dtype.itemsize <= 4
    return array.astype(np.float32 if small else np.float64)


def _whole(value: Any, name: str) -> int:
    """A whole number; a seed may be any, the others are counts."""
    array = np.asarray(value)
    if array.size != 1 or array.dtype.kind not in "fiu" or array.item() != int(array.item()):
        raise ValueError(f"{name} must be one whole number; found {array.dtype} {array.shape}")
    if name != "seed" and array.item() < 1:
        raise ValueError(f"{name} must be at least 1; found {array.item()}")
    return int(array.item())


def _description(picture: Picture) -> str:
    """All but the radiance, as JSON: its decimals give every float64 back exactly."""
    fields = _fields(picture)
    return json.dumps(
        {name: np.asarray(value).tolist() for name, value in fields.items() if name != "radiance"}
    )


def _described(description: Any) -> dict[str, Any]:
    """The keys of `_description`; none from a text that another program wrote."""
    try:
        found = json.loads(description)
    except (TypeError, ValueError):
        return {}
    keys = ("wavelength", *COUNTS) if isinstance(found, dict) else ()
    return {key: found[key] for key in keys if key in found}


def _read_npz(path: Path, instead: str = "radiance") -> dict[str, Any]:
    """The keys that are known, and `instead` of a radiance."""
    if not zipfile.is_zipfile(path):
        raise ValueError("it is no .npz archive")
    with np.load(path, allow_pickle=False) as archive:
        known = ("radiance", "wavelength", *COUNTS, instead)
        # Only the known keys are read: the others may hold anything, also what cannot be read.
        found = {name: archive[name] for name in known if name in archive.files}
        if not {"radiance", instead} & set(found):
            raise ValueError(f"it has no {instead}; found {sorted(archive.files) or 'nothing'}")
        return found


def _write_png(path: Path, picture: Picture, bits: int) -> None:
    rgb = linear_rgb(picture)
    if not np.isfinite(rgb).all():
        raise ValueError("radiance is not finite everywhere; .npz, .tiff and .exr keep that")
    levels = 2**bits - 1
    values = np.round(encode_srgb(rgb) * levels).astype(np.uint8 if bits == 8 else np.uint16)
    if bits == 8:
        iio.imwrite(path, values, plugin="pillow", extension=".png")
        return
    height, width, _ = values.shape
    writer = _extra_module("png", path).Writer(width, height, greyscale=False, bitdepth=16)
    with path.open("wb") as file:
        # Network byte order. Source: as PNG_SIGNATURE, section 7.1.
        writer.write_packed(file, (row.tobytes() for row in values.astype(">u2")))


def _read_png(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    if not data.startswith(PNG_SIGNATURE) or len(data) <= PNG_DEPTH_AT:
        raise ValueError("it is no PNG")
    if data[PNG_DEPTH_AT] == 16:
        rgba = _decode_png16(data, path)
    else:
        # Greys and palettes become red, green, blue and opacity of 8 bits on the way.
        rgba = iio.imread(data, plugin="pillow", extension=".png", mode="RGBA", index=0)
    levels = np.float64(np.iinfo(rgba.dtype).max)
    # The top code stands for all that is rounded to it, and for all that is brighter.
    ceiling = float(decode_srgb(np.array((levels - 0.5) / levels)))
    return {"radiance": decode_srgb(_opaque(rgba / levels)), "ceiling": ceiling}


def _decode_png16(data: bytes, path: Path) -> np.ndarray:
    """Red, green, blue, opacity of 16 bits, which Pillow would cut to 8."""
    width, height, rows, _ = _extra_module("png", path).Reader(bytes=data).asRGBA()
    pixels = np.vstack([np.asarray(row, np.uint16) for row in rows])
    return pixels.reshape(height, width, 4)


def _opaque(rgba: np.ndarray) -> np.ndarray:
    """The colours of a picture that hides nothing; what lies behind another is not known."""
    if not np.all(rgba[..., 3] == 1):
        raise ValueError("it is transparent in places")
    return rgba[..., :3]


def _write_tiff(path: Path, picture: Picture) -> None:
    radiance = picture.radiance.astype(np.float32)
    layout: dict[str, Any] = {"photometric": "minisblack", "planarconfig": "contig"}
    if picture.wavelengths is None:
        layout["photometric"] = "rgb"
    if radiance.shape[2] == 1:
        # tifffile takes a last axis of one for the columns of a picture.
        radiance, layout["planarconfig"] = radiance[..., 0], None
    # Without `metadata=None` tifffile writes a description of its own.
    _extra_module("tifffile", path).imwrite(
        path, radiance, metadata=None, description=_description(picture), **layout
    )


def _read_tiff(path: Path) -> dict[str, Any]:
    fields = _tiff_fields(path)
    if fields["radiance"].dtype.kind != "f":
        # Whether whole numbers are linear or encoded is a guess; in a PNG it is not.
        raise ValueError(f"its values must be floating-point; found {fields['radiance'].dtype}")
    return fields


def _tiff_fields(path: Path) -> dict[str, Any]:
    """The keys of a .tiff file, its values as they are."""
    with _extra_module("tifffile", path).TiffFile(path) as file:
        if len(file.pages) != 1:
            raise ValueError(f"it has {len(file.pages)} pages, not one")
        page = file.pages[0]
        values, fields = page.asarray(), _described(page.description)
        if page.axes.startswith("S"):
            values = np.moveaxis(values, 0, -1)
    if values.ndim == 2 and "wavelength" in fields:
        values = values[..., None]
    return {**fields, "radiance": values}


def _exr_bands(wavelengths: np.ndarray) -> list[str]:
    """Channel names of bands, exact to 1e-6 nm."""
    numbers = (f"{wavelength_nm:.6f}" for wavelength_nm in np.asarray(wavelengths) * 1e3)
    return [f"S0.{number.replace('.', ',')}nm" for number in numbers]


def _write_exr(path: Path, picture: Picture) -> None:
    names = ["R", "G", "B"] if picture.wavelengths is None else _exr_bands(picture.wavelengths)
    # Each plane in one piece: OpenEXR ignores strides and would write other pixels.
    planes = np.ascontiguousarray(np.moveaxis(picture.radiance, -1, 0), np.float32)
    header = {"diffdisp": _description(picture)}
    if picture.wavelengths is not None:
        header.update(EXR_ATTRIBUTES)
    exr = _extra_module("OpenEXR", path)
    exr.File(header, dict(zip(names, planes, strict=True))).write(str(path))


def _read_exr(path: Path) -> dict[str, Any]:
    with _extra_module("OpenEXR", path).File(str(path), separate_channels=True) as file:
        header = file.header()
        if not np.array_equal(header["dataWindow"], header["displayWindow"]):
            raise ValueError("it is a detail of a larger picture: data and display window differ")
        # Taken here: closing the file empties its header.
        described = _described(header.get("diffdisp"))
        planes = {name: channel.pixels for name, channel in file.channels().items()}
    fields = {name: described[name] for name in COUNTS if name in described}
    bands = {name: match for name in planes if (match := EXR_BAND.fullmatch(name))}
    # The names round the wavelengths and sort them as text: where our own attribute fits them, it
    # is the better source.
    names = _exr_bands(np.asarray(described.get("wavelength", []), np.float64))
    if bands and sorted(names) == sorted(bands):
        fields["wavelength"] = described["wavelength"]
    elif bands:
        found = {name: float(match["nm"].replace(",", ".")) / 1e3 for name, match in bands.items()}
        names = sorted(found, key=lambda name: found[name])
        fields["wavelength"] = [found[name] for name in names]
    elif {"R", "G", "B"} <= set(planes):
        names = ["R", "G", "B"]
        if "A" in planes:
            _opaque(np.stack([planes[name] for name in "RGBA"], axis=-1))
    else:
        raise ValueError(f"it has neither R, G, B nor spectral channels; found {sorted(planes)}")
    return {**fields, "radiance": np.stack([planes[name] for name in names], axis=-1)}


def _suffix(path: str | Path) -> str:
    """The suffix in lower case.

    Raises:
        ValueError: none that a picture has.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIX_MODULES:
        allowed = ", ".join(SUFFIX_MODULES)
        raise ValueError(f"{path}: a picture ends in one of {allowed}; found {suffix!r}")
    return suffix


def _extra_module(name: str | None, path: str | Path) -> Any:
    """The module that a format takes, if any.

    Raises:
        ImportError: its package is not installed; the message says how to.
    """
    if name is None:
        return None
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f"{path}: needs the package {EXTRA_PACKAGES[name]}: pip install 'diffdisp[io]'"
        ) from error


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A name beside `path` to write to, which takes its place once all is written.

    An interrupted run leaves the old file whole and nothing beside it.
    """
    # Through a link: the file it points to is replaced, not the link.
    target = Path(os.path.realpath(path))
    beside = target.parent / f".{secrets.token_hex(8)}{Path(path).suffix.lower()}"
    try:
        yield beside
        beside.replace(target)
    finally:
        beside.unlink(missing_ok=True)
