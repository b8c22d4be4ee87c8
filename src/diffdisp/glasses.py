"""The table of named glasses, and readers for glass catalogue files."""

import difflib
import os
import re
import warnings
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from diffdisp.dispersion import Sellmeier, real_array


class _Published(NamedTuple):
    """One printed dispersion formula: B, C in µm², the fitted range in µm, where it is printed."""

    B: tuple[float, ...]
    C: tuple[float, ...]
    validity: tuple[float, float]
    source: str


_SCHOTT = (
    "Schott, Optical Glass data sheets (edition of 2018-06-01); "
    "range: Schott Zemax catalogue 2017-01-20b"
)

# Name, B1 B2 B3, C1 C2 C3 in µm², range in µm. N-F2 and F2 are two glasses, and so on.
_SCHOTT_TABLE = """
N-BK7    1.03961212   0.231792344  1.01046945   0.00600069867 0.0200179144 103.560653 0.3   2.5
N-K5     1.08511833   0.199562005  0.930511663  0.00661099503 0.024110866  111.982777 0.31  2.5
K7       1.1273555    0.124412303  0.827100531  0.00720341707 0.0269835916 100.384588 0.31  2.5
N-BAK4   1.28834642   0.132817724  0.945395373  0.00779980626 0.0315631177 105.965875 0.334 2.5
N-BAF10  1.5851495    0.143559385  1.08521269   0.00926681282 0.0424489805 105.613573 0.35  2.5
N-SK16   1.34317774   0.241144399  0.994317969  0.00704687339 0.0229005    92.7508526 0.31  2.5
N-SSK5   1.59222659   0.103520774  1.05174016   0.00920284626 0.0423530072 106.927374 0.35  2.5
N-FK5    0.844309338  0.344147824  0.910790213  0.00475111955 0.0149814849 97.8600293 0.26  2.5
N-FK51A  0.971247817  0.216901417  0.904651666  0.00472301995 0.0153575612 168.68133  0.29  2.5
N-PK51   1.15610775   0.153229344  0.785618966  0.00585597402 0.0194072416 140.537046 0.3   2.5
N-PK52A  1.029607     0.1880506    0.736488165  0.00516800155 0.0166658798 138.964129 0.29  2.5
N-LAK9   1.46231905   0.344399589  1.15508372   0.00724270156 0.0243353131 85.4686868 0.3   2.5
N-LAK22  1.14229781   0.535138441  1.04088385   0.00585778594 0.0198546147 100.834017 0.31  2.5
N-LAF2   1.80984227   0.15729555   1.0930037    0.0101711622  0.0442431765 100.687748 0.35  2.5
N-LASF9  2.00029547   0.298926886  1.80691843   0.0121426017  0.0538736236 156.530829 0.365 2.5
N-LASF44 1.78897105   0.38675867   1.30506243   0.00872506277 0.0308085023 92.7743824 0.334 2.5
N-KZFS4  1.35055424   0.197575506  1.09962992   0.0087628207  0.0371767201 90.3866994 0.334 2.5
LLF1     1.21640125   0.13366454   0.883399468  0.00857807248 0.0420143003 107.59306  0.31  2.5
LF5      1.28035628   0.163505973  0.893930112  0.00929854416 0.0449135769 110.493685 0.32  2.325
F5       1.3104463    0.19603426   0.96612977   0.00958633048 0.0457627627 115.011883 0.32  2.5
F2       1.34533359   0.209073176  0.937357162  0.00997743871 0.0470450767 111.886764 0.32  2.5
N-F2     1.39757037   0.159201403  1.2686543    0.00995906143 0.0546931752 119.248346 0.365 2.5
SF5      1.46141885   0.247713019  0.949995832  0.0111826126  0.0508594669 112.041888 0.35  2.5
N-SF5    1.52481889   0.187085527  1.42729015   0.011254756   0.0588995392 129.141675 0.37  2.5
SF6      1.72448482   0.390104889  1.04572858   0.0134871947  0.0569318095 118.557185 0.365 2.5
N-SF6    1.77931763   0.338149866  2.08734474   0.0133714182  0.0617533621 174.01759  0.37  2.5
SF10     1.61625977   0.259229334  1.07762317   0.0127534559  0.0581983954 116.60768  0.38  2.5
N-SF10   1.62153902   0.256287842  1.64447552   0.0122241457  0.0595736775 147.468793 0.38  2.5
SF11     1.73848403   0.311168974  1.17490871   0.0136068604  0.0615960463 121.922711 0.39  2.5
N-SF11   1.73759695   0.313747346  1.89878101   0.013188707   0.0623068142 155.23629  0.37  2.5
SF57     1.81651371   0.428893641  1.07186278   0.0143704198  0.0592801172 121.419942 0.37  2.5
N-SF57   1.87543831   0.37375749   2.30001797   0.0141749518  0.0640509927 177.389795 0.37  2.5
N-SF66   2.0245976    0.470187196  2.59970433   0.0147053225  0.0692998276 161.817601 0.39  2.5
"""

_SCHOTT_ZEMAX = "Schott Zemax catalogue 2017-01-20b, as the refractiveindex.info database has it"

_SCHOTT_ZEMAX_TABLE = """
N-BK10   0.888308131 0.328964475  0.984610769 0.00516900822 0.0161190045 99.7575331 0.29  2.5
N-KF9    1.19286778  0.0893346571 0.920819805 0.00839154696 0.0404010786 112.572446 0.35  2.5
N-BAK1   1.12365662  0.309276848  0.881511957 0.00644742752 0.0222284402 107.297751 0.3   2.5
N-BAK2   1.01662154  0.319903051  0.937232995 0.00592383763 0.0203828415 113.118417 0.3   2.5
N-BAF4   1.42056328  0.102721269  1.14380976  0.00942015382 0.0531087291 110.278856 0.365 2.5
N-BALF4  1.31004128  0.142038259  0.964929351 0.0079659645  0.0330672072 109.19732  0.35  2.5
N-BASF64 1.65554268  0.17131977   1.33664448  0.0104485644  0.0499394756 118.961472 0.365 2.5
N-SK2    1.28189012  0.257738258  0.96818604  0.0072719164  0.0242823527 110.377773 0.31  2.5
N-SK14   0.936155374 0.594052018  1.04374583  0.00461716525 0.016885927  103.736265 0.31  2.5
N-SSK8   1.44857867  0.117965926  1.06937528  0.00869310149 0.0421566593 111.300666 0.35  2.5
N-LAK8   1.33183167  0.546623206  1.19084015  0.00620023871 0.0216465439 82.5827736 0.31  2.5
N-LAK14  1.50781212  0.318866829  1.14287213  0.00746098727 0.0242024834 80.9565165 0.31  2.5
N-SF1    1.60865158  0.237725916  1.51530653  0.0119654879  0.0590589722 135.521676 0.37  2.5
N-SF4    1.67780282  0.282849893  1.63539276  0.012679345   0.0602038419 145.760496 0.365 2.5
"""

# The papers print the resonance wavelengths; C is their square.
_PAPERS = {
    "fused silica": _Published(
        B=(0.6961663, 0.4079426, 0.8974794),
        C=(0.0684043**2, 0.1162414**2, 9.896161**2),
        validity=(0.21, 3.71),
        source="Malitson, J. Opt. Soc. Am. 55, 1205 (1965), 20 °C",
    ),
    "sapphire": _Published(
        B=(1.4313493, 0.65054713, 5.3414021),
        C=(0.0726631**2, 0.1193242**2, 18.028251**2),
        validity=(0.2, 5.0),
        source="Malitson & Dodge, J. Opt. Soc. Am. 62, 1405 (1972), ordinary ray, 20 °C; formula "
        "printed in Dodge, Handbook of Laser Science and Technology IV (CRC, 1986), p. 30",
    ),
    "CaF2": _Published(
        B=(0.5675888, 0.4710914, 3.8484723),
        C=(0.050263605**2, 0.1003909**2, 34.649040**2),
        validity=(0.23, 9.7),
        source="Malitson, Appl. Opt. 2, 1103 (1963), calcium fluoride, 24 °C",
    ),
    "BaF2": _Published(
        B=(0.643356, 0.506762, 3.8261),
        C=(0.057789**2, 0.10968**2, 46.3864**2),
        validity=(0.2652, 10.346),
        source="Malitson, J. Opt. Soc. Am. 54, 628 (1964), barium fluoride (not the barium flint "
        "that CDGM sells as BAF2), 25 °C",
    ),
    "MgF2": _Published(
        B=(0.48755108, 0.39875031, 2.3120353),
        C=(0.04338408**2, 0.09461442**2, 23.793604**2),
        validity=(0.2, 7.0),
        source="Dodge, Appl. Opt. 23, 1980 (1984), magnesium fluoride, ordinary ray, 19 °C",
    ),
    "LiF": _Published(
        B=(0.92549, 6.96747, 0.0),
        C=(0.07376**2, 32.790**2, 0.0),
        validity=(0.1, 11.0),
        source="Li, J. Phys. Chem. Ref. Data 5, 329 (1976), lithium fluoride, two terms, 24 °C",
    ),
    "diamond": _Published(
        B=(0.3306, 4.3356, 0.0),
        C=(0.1750**2, 0.1060**2, 0.0),
        validity=(0.226, 0.76),
        source="Peter, Z. Phys. 15, 358 (1923), two terms, room temperature",
    ),
}


def _rows(table: str, source: str) -> dict[str, _Published]:
    """The rows of a Schott table by catalogue name."""
    published = {}
    for row in table.strip().splitlines():
        name, *words = row.split()
        B1, B2, B3, C1, C2, C3, low, high = map(float, words)
        published[name] = _Published((B1, B2, B3), (C1, C2, C3), (low, high), source)
    return published


_TABLE = _rows(_SCHOTT_TABLE, _SCHOTT) | _rows(_SCHOTT_ZEMAX_TABLE, _SCHOTT_ZEMAX) | _PAPERS

_CATALOGUE_SUFFIXES = (".agf", ".yml", ".yaml")


def glass_table() -> dict[str, Sellmeier]:
    """All glasses of the table, by catalogue name.

    Returns:
        a new dictionary; `glass_source(name)` says where each was published.
    """
    return {name: _named(name) for name in _TABLE}


def named_glass(name: str) -> Sellmeier:
    """The glass of that catalogue name.

    Args:
        name: capitals, spaces, hyphens and underscores do not matter: "n-bk7", "Fused Silica".

    Returns:
        the glass under its exact catalogue name.

    Raises:
        ValueError: no such glass in the table; the message lists similar names.
    """
    return _named(_exact_name(name))


def glass_source(name: str) -> str:
    """Where the coefficients of a glass of the table were published.

    Args:
        name: as `named_glass` takes it.

    Returns:
        the data sheet or paper.

    Raises:
        ValueError: no such glass in the table.
    """
    return _TABLE[_exact_name(name)].source


def load_glass(name_or_path: str | os.PathLike[str]) -> Sellmeier:
    """One glass, from the table or from a file.

    Args:
        name_or_path: as `load_glasses` takes it.

    Returns:
        the glass.

    Raises:
        ValueError: as `load_glasses`; or a catalogue of several glasses without a name.
        OSError: the file cannot be read.
    """
    glasses = load_glasses(name_or_path)
    if len(glasses) > 1:
        names = ", ".join(glass.name for glass in glasses[:8])
        raise ValueError(
            f"{os.fspath(name_or_path)}: holds {len(glasses)} glasses ({names}"
            f"{', …' if len(glasses) > 8 else ''}), one is wanted: name it by FILE.agf:NAME"
        )
    return glasses[0]


def load_glasses(name_or_path: str | os.PathLike[str]) -> list[Sellmeier]:
    """Every glass that a name or a file stands for.

    Args:
        name_or_path: a path ending in .agf, .yml or .yaml; FILE.agf:NAME for one glass of a
            catalogue; anything else is a name of the table.

    Returns:
        one glass; several for an .agf file without a name.

    Raises:
        ValueError: unknown name, or a file that holds no glass of a supported formula.
        OSError: the file cannot be read.
    """
    text = os.fspath(name_or_path)
    in_catalogue = re.fullmatch(r"(.+\.agf):(.+)", text, re.IGNORECASE)
    if in_catalogue:
        return read_agf(in_catalogue[1], in_catalogue[2])
    suffix = Path(text).suffix.lower()
    if suffix == ".agf":
        return read_agf(text)
    if suffix in _CATALOGUE_SUFFIXES:
        return [read_refractiveindex_yaml(text)]
    return [named_glass(text)]


# Numbers and names of the formulas.
# Source: Ansys Zemax OpticStudio help, dispersion formulas; 1 to 12 as in ZemaxGlass 1.0.
_AGF_FORMULAS = {
    1: "Schott",
    2: "Sellmeier 1",
    3: "Herzberger",
    4: "Sellmeier 2",
    5: "Conrady",
    6: "Sellmeier 3",
    7: "Handbook of Optics 1",
    8: "Handbook of Optics 2",
    9: "Sellmeier 4",
    10: "Extended 1",
    11: "Sellmeier 5",
    12: "Extended 2",
    13: "Extended 3",
}
_SUPPORTED = "formula 2 (Sellmeier 1)"


class _AgfRecord(NamedTuple):
    """The lines of one glass: words of NM, CD and LD, still unread."""

    where: str
    NM: list[str]
    CD: list[str]
    LD: list[str]


def read_agf(path: str | os.PathLike[str], name: str | None = None) -> list[Sellmeier]:
    """The three-term Sellmeier glasses of a Zemax glass catalogue.

    Args:
        path: the .agf file, in UTF-16, UTF-8 or Latin-1.
        name: one glass of the catalogue, as `named_glass` compares names; None for all.

    Returns:
        the glasses of formula 2 in the order of the file. Without `name`, a warning names the
        glasses that are left out and their formulas.

    Raises:
        ValueError: no glass in the file, none of that name, the named one (or every one) has
            another formula, or a line of a wanted glass is not what the format says.
        OSError: the file cannot be read.

    Source:
        Ansys Zemax OpticStudio help, "AGF file format": NM name, formula; CD coefficients, for
        formula 2 K1 L1 K2 L2 K3 L3; LD shortest and longest wavelength in µm.
    """
    file = os.fspath(path)
    records = _agf_records(file)
    if not records:
        raise ValueError(f"{file}: holds no glass: no line begins with NM, as in a Zemax catalogue")
    if name is not None:
        by_key = {_key(record.NM[1]): record.NM[1] for record in records}
        if _key(name) not in by_key:
            raise ValueError(
                f"{file}: has no glass {name!r}{_similar(name, by_key)}; it holds {len(by_key)}"
            )
        records = [record for record in records if _key(record.NM[1]) == _key(name)]
    supported = [record for record in records if _agf_formula(record) == _SUPPORTED]
    others: dict[str, list[str]] = {}
    for record in records:
        if record not in supported:
            others.setdefault(_agf_formula(record), []).append(record.NM[1])
    refused = "; ".join(f"{formula}: {', '.join(names)}" for formula, names in others.items())
    if not supported:
        raise ValueError(f"{file}: only {_SUPPORTED} is supported, found {refused}")
    if refused:
        warnings.warn(f"{file}: only {_SUPPORTED} is supported, left out {refused}", stacklevel=2)
    return [_agf_glass(record) for record in supported]


def read_refractiveindex_yaml(path: str | os.PathLike[str]) -> Sellmeier:
    """The Sellmeier glass of one file of the refractiveindex.info database.

    Args:
        path: the .yml file; the glass is named after it.

    Returns:
        the glass; with fewer than three terms the others are 0. A warning says so where the
        file gives the index or the wavelength in vacuum: the glass then takes them as in air.

    Raises:
        ValueError: not such a file; another formula, several formulas or only a table; more than
            three terms; a constant other than 0.
        OSError: the file cannot be read.

    Source:
        refractiveindex.info database, "Dispersion formulas": formula 1 is
        n² - 1 = c1 + Σ c2 λ² / (λ² - c3²) + …, formula 2 the same with c3 not squared.
    """
    import yaml  # type: ignore[import-untyped, unused-ignore]

    file = os.fspath(path)
    try:
        text = Path(file).read_text(encoding="utf-8")
        # The one in C reads a long table ten times as fast, where there is one.
        content = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{file}: is not a YAML file: {' '.join(str(error).split())}") from error
    entry = _formula_entry(file, content)
    formula = " ".join(str(entry["type"]).split())
    constant, *terms = _numbers(file, "coefficients", str(entry.get("coefficients", "")).split())
    if len(terms) % 2:
        raise ValueError(
            f"{file}: {1 + len(terms)} coefficients found, {formula} has a constant and pairs"
        )
    pairs = [(b, c) for b, c in zip(terms[::2], terms[1::2], strict=True) if b != 0]
    if constant != 0 or len(pairs) > 3:
        raise ValueError(
            f"{file}: constant {constant:g} and {len(pairs)} Sellmeier terms found; a glass here "
            "has constant 0 and at most three terms"
        )
    pairs += [(0.0, 0.0)] * (3 - len(pairs))
    for section in ("CONDITIONS", "SPECS"):
        _warn_of_vacuum(file, content.get(section))
    return Sellmeier(
        B=real_array([b for b, _ in pairs]),
        C=real_array([c**2 if formula == "formula 1" else c for _, c in pairs]),
        validity=_validity(
            file, "wavelength_range", str(entry.get("wavelength_range", "")).split()
        ),
        name=Path(file).stem,
    )


def _named(name: str) -> Sellmeier:
    """The glass of the table under its exact name."""
    published = _TABLE[name]
    return Sellmeier(
        B=real_array(published.B),
        C=real_array(published.C),
        validity=real_array(published.validity),
        name=name,
    )


def _key(name: str) -> str:
    """What is compared of a name: "N-BK7", "n bk7" and "n_bk7" are one glass."""
    return re.sub(r"[\s_-]", "", name).lower()


def _exact_name(name: str) -> str:
    """The catalogue name that `name` stands for."""
    exact = {_key(known): known for known in _TABLE}
    if _key(name) not in exact:
        raise ValueError(
            f"unknown glass {name!r}{_similar(name, exact)}; glass_table() holds all "
            f"{len(exact)}; a file ends in {', '.join(_CATALOGUE_SUFFIXES)}"
        )
    return exact[_key(name)]


def _similar(name: str, exact: dict[str, str]) -> str:
    """A clause with the names most like `name`; empty where none is."""
    near = difflib.get_close_matches(_key(name), exact, n=5, cutoff=0.5)
    return f", similar are {', '.join(exact[key] for key in near)}" if near else ""


def _numbers(where: str, what: str, words: list[str]) -> list[float]:
    """Finite numbers of `words`, at least one."""
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if not numbers or not np.all(np.isfinite(numbers)):
        raise ValueError(f"{where}: {what} must be finite numbers, found {' '.join(words)!r}")
    return numbers


def _validity(where: str, what: str, words: list[str]) -> np.ndarray | jax.Array:
    """The range in `words`, µm; unlimited where there are none."""
    if not words:
        return real_array((0.0, np.inf))
    bounds = _numbers(where, what, words)
    if len(bounds) != 2 or not 0 <= bounds[0] < bounds[1]:
        raise ValueError(
            f"{where}: {what} must be two rising wavelengths in µm, found {' '.join(words)!r}"
        )
    return real_array(bounds)


def _agf_records(file: str) -> list[_AgfRecord]:
    """The glasses of a catalogue, unread; each begins with its NM line."""
    records: list[_AgfRecord] = []
    for number, line in enumerate(_decoded(Path(file).read_bytes()).split("\n"), start=1):
        words = line.split()
        if words[:1] == ["NM"]:
            if len(words) < 3:
                raise ValueError(
                    f"{file}, line {number}: NM must give a name and a formula number, "
                    f"found {line.strip()!r}"
                )
            records.append(_AgfRecord(f"{file}, line {number}", words, [], []))
        elif words and words[0] in ("CD", "LD") and records:
            getattr(records[-1], words[0]).extend(words[1:])
    return records


def _decoded(data: bytes) -> str:
    """Text of a catalogue: Zemax writes UTF-16, older versions and people one byte a letter."""
    if data.startswith((b"\xff\xfe", b"\xfe\xff")):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _agf_formula(record: _AgfRecord) -> str:
    """Number and name of the dispersion formula of a record."""
    found = record.NM[2]
    if not re.fullmatch(r"\d+(\.0*)?", found):  # some writers print 2.0
        return f"formula {found} (unknown)"
    number = int(float(found))
    return f"formula {number} ({_AGF_FORMULAS.get(number, 'unknown')})"


def _agf_glass(record: _AgfRecord) -> Sellmeier:
    """The glass of a record of formula 2."""
    where, name = record.where, record.NM[1]
    numbers = _numbers(where, f"CD of {name}", record.CD)
    if len(numbers) < 6:
        raise ValueError(
            f"{where}: CD of {name} must give K1 L1 K2 L2 K3 L3, found {len(numbers)} numbers"
        )
    return Sellmeier(
        B=real_array(numbers[0:6:2]),
        C=real_array(numbers[1:6:2]),
        validity=_validity(where, f"LD of {name}", record.LD),
        name=name,
    )


def _formula_entry(file: str, content: object) -> dict[str, object]:
    """The one entry of DATA that gives n by formula 1 or 2; tables of k are passed over."""
    data = content.get("DATA") if isinstance(content, dict) else None
    if not isinstance(data, list) or not all(isinstance(e, dict) and "type" in e for e in data):
        raise ValueError(
            f"{file}: is no refractiveindex.info file: DATA, a list of entries with a type, is "
            "missing"
        )
    entries = [e for e in data if " ".join(str(e["type"]).split()) != "tabulated k"]
    types = ", ".join(" ".join(str(e["type"]).split()) for e in entries)
    if types not in ("formula 1", "formula 2"):
        raise ValueError(
            f"{file}: gives n by {types or 'no formula'}; one formula 1 or one formula 2, both "
            "Sellmeier, is supported"
        )
    entry: dict[str, object] = entries[0]
    return entry


def _warn_of_vacuum(file: str, conditions: object) -> None:
    """Warn where the file's index or wavelength is one in vacuum."""
    if not isinstance(conditions, dict):
        return
    for key in ("n_is_absolute", "wavelength_is_vacuum"):
        if conditions.get(key) is True:
            warnings.warn(
                f"{file}: {key} is true; the values are taken as in air, which changes n by up "
                "to 3e-4 of itself (n_is_absolute) or λ by as much (wavelength_is_vacuum)",
                stacklevel=3,
            )
