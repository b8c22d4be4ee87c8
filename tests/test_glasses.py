import warnings
from pathlib import Path

import numpy as np
import pytest

from diffdisp.dispersion import Sellmeier
from diffdisp.glasses import (
    glass_source,
    glass_table,
    load_glass,
    load_glasses,
    named_glass,
    read_agf,
    read_refractiveindex_yaml,
)

FIXTURES = Path(__file__).parent.parent / "fixtures" / "glasses"

# n_d, V_d, P_gF as printed in Schott, Optical Glass data sheets (edition of 2018-06-01).
SCHOTT = [
    ("N-BK7", 1.51680, 64.17, 0.5349),
    ("N-K5", 1.52249, 59.48, 0.5438),
    ("K7", 1.51112, 60.41, 0.5422),
    ("N-BAK4", 1.56883, 55.98, 0.5487),
    ("N-BAF10", 1.67003, 47.11, 0.5629),
    ("N-SK16", 1.62041, 60.32, 0.5412),
    ("N-SSK5", 1.65844, 50.88, 0.5575),
    ("N-FK5", 1.48749, 70.41, 0.5290),
    ("N-FK51A", 1.48656, 84.47, 0.5359),
    ("N-PK51", 1.52855, 76.98, 0.5401),
    ("N-PK52A", 1.49700, 81.61, 0.5377),
    ("N-LAK9", 1.69100, 54.71, 0.5447),
    ("N-LAK22", 1.65113, 55.89, 0.5467),
    ("N-LAF2", 1.74397, 44.85, 0.5656),
    ("N-LASF9", 1.85025, 32.17, 0.5934),
    ("N-LASF44", 1.80420, 46.50, 0.5572),
    ("N-KZFS4", 1.61336, 44.49, 0.5590),
    ("LLF1", 1.54814, 45.75, 0.5660),
    ("LF5", 1.58144, 40.85, 0.5748),
    ("F5", 1.60342, 38.03, 0.5795),
    ("F2", 1.62004, 36.37, 0.5828),
    ("N-F2", 1.62005, 36.43, 0.5881),
    ("SF5", 1.67270, 32.21, 0.5919),
    ("N-SF5", 1.67271, 32.25, 0.5984),
    ("SF6", 1.80518, 25.43, 0.6102),
    ("N-SF6", 1.80518, 25.36, 0.6158),
    ("SF10", 1.72825, 28.41, 0.6046),
    ("N-SF10", 1.72828, 28.53, 0.6066),
    ("SF11", 1.78472, 25.76, 0.6147),
    ("N-SF11", 1.78472, 25.68, 0.6156),
    ("SF57", 1.84666, 23.83, 0.6160),
    ("N-SF57", 1.84666, 23.78, 0.6216),
    ("N-SF66", 1.92286, 20.88, 0.6394),
]
# n_d, V_d and ΔP_gF, the deviation from the normal line, as in Schott Zemax catalogue 2017-01-20b.
SCHOTT_ZEMAX = [
    ("N-BAF4", 1.60568, 43.72, 0.003),
    ("N-BAK1", 1.57250, 57.55, 0.0002),
    ("N-BAK2", 1.53996, 59.71, 0.0004),
    ("N-BALF4", 1.57956, 53.87, -0.0012),
    ("N-BASF64", 1.70400, 39.38, -0.0006),
    ("N-BK10", 1.49782, 66.95, -0.0008),
    ("N-KF9", 1.52346, 51.54, -0.0014),
    ("N-LAK14", 1.69680, 55.41, -0.0079),
    ("N-LAK8", 1.71300, 53.83, -0.0083),
    ("N-SF1", 1.71736, 29.62, 0.0097),
    ("N-SF4", 1.75513, 27.38, 0.0118),
    ("N-SK14", 1.60311, 60.60, -0.0003),
    ("N-SK2", 1.60738, 56.65, -0.0008),
    ("N-SSK8", 1.61773, 49.83, 0.0002),
]
# n_d and V_d as Zemax prints them in its catalogues MISC (F_SILICA), BIREFRINGENT (AL2O3, MGF2)
# and INFRARED (CAF2, BAF2, LIF); diamond as refractiveindex.info does.
OTHERS = [
    ("fused silica", 1.458464, 67.821433),
    ("sapphire", 1.768172, 72.308589),
    ("CaF2", 1.433849, 94.995854),
    ("BaF2", 1.474478, 81.607872),
    ("MgF2", 1.377744, 106.217612),
    ("LiF", 1.392146, 97.294682),
    ("diamond", 2.41748, 55.30),
]
# n at six lines, µm, from the same Schott data sheets, infrared and violet included.
LINES = (2.3254, 1.5296, 1.0600, 0.6562725, 0.4861327, 0.4046561)
SCHOTT_LINES = [
    ("N-BK7", (1.48921, 1.50091, 1.50669, 1.51432, 1.52238, 1.53024)),
    ("F2", (1.58465, 1.59513, 1.60190, 1.61503, 1.63208, 1.65064)),
    ("N-SF11", (1.72937, 1.74377, 1.75401, 1.77596, 1.80651, 1.84235)),
    ("N-FK51A", (1.46958, 1.47608, 1.47959, 1.48480, 1.49056, 1.49618)),
    ("N-LASF44", (1.76070, 1.77590, 1.78455, 1.79901, 1.81630, 1.83405)),
]


@pytest.mark.parametrize(("name", "n_d", "V_d", "P_gF"), SCHOTT)
def test_schott_glass_agrees_with_its_data_sheet(name, n_d, V_d, P_gF):
    glass = named_glass(name)
    # Half a unit of the last printed digit, and a little for the rounded coefficients.
    assert abs(float(glass.n_d) - n_d) < 0.6e-5
    assert abs(float(glass.V_d) - V_d) < 0.6e-2
    assert abs(float(glass.P_gF) - P_gF) < 0.6e-4


@pytest.mark.parametrize(("name", "n_d", "V_d", "off"), SCHOTT_ZEMAX)
def test_schott_glass_agrees_with_its_catalogue(name, n_d, V_d, off):
    glass = named_glass(name)
    assert abs(float(glass.n_d) - n_d) < 0.6e-5
    assert abs(float(glass.V_d) - V_d) < 0.6e-2
    # The normal line is that of K7 and F2, as Schott TIE-29 (2016) gives it. Half a unit of the
    # last printed digit each, for ΔP_gF and for the line's own constants.
    normal = 0.6438 - 0.001682 * float(glass.V_d)
    assert abs(float(glass.P_gF) - normal - off) < 1.1e-4


@pytest.mark.parametrize(("name", "n"), SCHOTT_LINES)
def test_schott_glass_agrees_with_its_data_sheet_at_other_lines(name, n):
    # Printed to five decimals; Schott's own fit is good to 5e-6 and the lines are rounded.
    np.testing.assert_allclose(named_glass(name).indices(np.array(LINES)), n, rtol=0, atol=1.1e-5)


@pytest.mark.parametrize(("name", "n_d", "V_d"), OTHERS)
def test_crystal_agrees_with_printed_values(name, n_d, V_d):
    glass = named_glass(name)
    # Zemax rounds C before it computes (BaF2: three digits, 4e-3 in V_d); diamond is printed for
    # 0.5876 µm, which is 5e-6 lower in n, and to five decimals.
    assert abs(float(glass.n_d) - n_d) < 1e-5
    assert abs(float(glass.V_d) - V_d) < 0.5e-2


def test_every_glass_of_the_table_has_a_printed_truth_and_a_source():
    assert set(glass_table()) == {name for name, *_ in SCHOTT + SCHOTT_ZEMAX + OTHERS}
    for name, glass in glass_table().items():
        assert glass.name == name
        assert any(year in glass_source(name) for year in ("2018", "2017", "19"))
        low, high = glass.validity
        assert 0.05 < low < 0.4  # µm, every one is printed for the visible
        assert 0.7 < high < 12


def test_glass_table_is_a_copy():
    glass_table().clear()
    assert glass_table()


@pytest.mark.parametrize(
    ("spelling", "name"),
    [
        ("N-BK7", "N-BK7"),
        ("n-bk7", "N-BK7"),
        ("nbk7", "N-BK7"),
        (" N BK7 ", "N-BK7"),
        ("Fused Silica", "fused silica"),
        ("fused_silica", "fused silica"),
        ("fusedsilica", "fused silica"),
        ("f2", "F2"),
        ("n-f2", "N-F2"),
        ("caf2", "CaF2"),
        ("Diamond", "diamond"),
    ],
)
def test_spelling_does_not_matter(spelling, name):
    assert named_glass(spelling).name == name
    assert glass_source(spelling) == glass_source(name)


def test_namesakes_are_different_glasses():
    assert float(named_glass("N-F2").V_d) != pytest.approx(float(named_glass("F2").V_d), abs=0.05)


@pytest.mark.parametrize("lookup", [named_glass, glass_source, load_glass, load_glasses])
def test_unknown_name_lists_similar_ones(lookup):
    with pytest.raises(ValueError, match=r"unknown glass 'BK7', similar are .*N-BK7.*glass_table"):
        lookup("BK7")


def test_unknown_name_without_a_similar_one():
    with pytest.raises(ValueError, match=r"unknown glass 'xyzzy'; glass_table\(\) holds all 54"):
        named_glass("xyzzy")


# Zemax catalogues.


def write_agf(folder, text, encoding="utf-8"):
    path = folder / "own.AGF"
    path.write_bytes(text.replace("\n", "\r\n").encode(encoding))
    return path


BK7_LINES = (
    "NM N-BK7 2 517642.251 1.5168 64.17 0 1\n"
    "CD 1.03961212 0.00600069867 0.231792344 0.0200179144 1.01046945 103.560653 0 0\n"
    "LD 0.3 2.5\n"
)


def assert_same_glass(glass: Sellmeier, expected: Sellmeier, name: str):
    np.testing.assert_allclose(glass.B, expected.B, rtol=1e-12)  # one rounding at most
    np.testing.assert_allclose(glass.C, expected.C, rtol=1e-12)
    assert glass.name == name


def test_agf_gives_its_three_term_glasses_and_names_the_others():
    with pytest.warns(
        UserWarning,
        match=r"sample\.agf: only formula 2 \(Sellmeier 1\).*"
        r"formula 1 \(Schott\): WATER; formula 6 \(Sellmeier 3\): CALCITE",
    ):
        glasses = read_agf(FIXTURES / "sample.agf")
    assert [glass.name for glass in glasses] == ["N-BK7", "F2", "N-SF11"]
    for glass in glasses:
        assert_same_glass(glass, named_glass(glass.name), glass.name)
        np.testing.assert_array_equal(glass.validity, named_glass(glass.name).validity)


@pytest.mark.parametrize("name", ["F2", "f2"])
def test_agf_by_name_does_not_warn_of_the_others(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (glass,) = read_agf(FIXTURES / "sample.agf", name)
    assert_same_glass(glass, named_glass("F2"), "F2")


def test_agf_refuses_another_formula_by_name():
    with pytest.raises(ValueError, match=r"sample\.agf: .*found formula 1 \(Schott\): WATER"):
        read_agf(FIXTURES / "sample.agf", "WATER")


def test_agf_without_that_glass_lists_similar_ones():
    with pytest.raises(ValueError, match=r"has no glass 'N-SF1', similar are .*N-SF11.*holds 5"):
        read_agf(FIXTURES / "sample.agf", "N-SF1")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig", "latin-1"])
def test_agf_encodings(tmp_path, encoding):
    path = write_agf(tmp_path, "CC Gläser, 20 °C\n" + BK7_LINES, encoding)
    (glass,) = read_agf(path)
    assert_same_glass(glass, named_glass("N-BK7"), "N-BK7")


def test_agf_formula_number_with_a_point(tmp_path):
    (glass,) = read_agf(write_agf(tmp_path, BK7_LINES.replace(" 2 517", " 2.0 517")))
    assert glass.name == "N-BK7"


def test_agf_without_range_is_valid_everywhere(tmp_path):
    (glass,) = read_agf(write_agf(tmp_path, BK7_LINES.replace("LD 0.3 2.5\n", "")))
    np.testing.assert_array_equal(glass.validity, [0, np.inf])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no glass"),
        ("CC only a comment\nCD 1 2 3\n", "holds no glass"),
        ("NM N-BK7\n", r"line 1: NM must give a name and a formula number, found 'NM N-BK7'"),
        (BK7_LINES.replace(" 2 517", " 3 517"), r"found formula 3 \(Herzberger\): N-BK7"),
        (BK7_LINES.replace(" 2 517", " 99 517"), r"found formula 99 \(unknown\): N-BK7"),
        (BK7_LINES.replace(" 2 517", " two 517"), r"found formula two \(unknown\): N-BK7"),
        (BK7_LINES.replace("1.0396", "one"), "CD of N-BK7 must be finite numbers, found 'one"),
        (BK7_LINES.replace("1.03961212", "nan"), "CD of N-BK7 must be finite numbers"),
        ("NM A 2 0 1.5 60\nLD 0.3 2.5\n", "line 1: CD of A must be finite numbers, found ''"),
        ("NM A 2 0 1.5 60\nCD 1 0.01\n", "CD of A must give K1 L1 K2 L2 K3 L3, found 2 numbers"),
        (BK7_LINES.replace("0.3 2.5", "2.5 0.3"), "LD of N-BK7 must be two rising wavelengths"),
        (BK7_LINES.replace("0.3 2.5", "0.3"), "LD of N-BK7 must be two rising wavelengths"),
    ],
)
def test_bad_agf_is_refused(tmp_path, text, message):
    with pytest.raises(ValueError, match=rf"own\.AGF.*{message}"):
        read_agf(write_agf(tmp_path, text))


# refractiveindex.info.


def write_yaml(folder, kind, coefficients, more=""):
    path = folder / "own.yml"
    path.write_text(
        f"DATA:\n  - type: {kind} \n    wavelength_range: 0.3 2.5\n"
        f"    coefficients: {coefficients}\n{more}",
        encoding="utf-8",
    )
    return path


def test_formula_1_squares_the_resonance_wavelengths():
    glass = read_refractiveindex_yaml(FIXTURES / "fused silica.yml")
    assert_same_glass(glass, named_glass("fused silica"), "fused silica")
    np.testing.assert_array_equal(glass.validity, [0.21, 6.7])


def test_formula_2_does_not():
    glass = read_refractiveindex_yaml(FIXTURES / "N-BK7.yml")
    assert_same_glass(glass, named_glass("N-BK7"), "N-BK7")
    np.testing.assert_array_equal(glass.validity, [0.3, 2.5])


def test_missing_terms_are_zero(tmp_path):
    glass = read_refractiveindex_yaml(write_yaml(tmp_path, "formula 1", "0 0.5 0.1"))
    np.testing.assert_allclose(glass.B, [0.5, 0, 0], rtol=0)
    np.testing.assert_allclose(glass.C, [0.1**2, 0, 0], rtol=1e-15)


def test_terms_of_no_strength_do_not_count(tmp_path):
    text = "0 1.1 0.01 0 0.02 0.2 0.03 0.9 100 0 0"
    glass = read_refractiveindex_yaml(write_yaml(tmp_path, "formula 2", text))
    np.testing.assert_allclose(glass.C, [0.01, 0.03, 100], rtol=0)


@pytest.mark.parametrize("section", ["CONDITIONS", "SPECS"])
def test_vacuum_values_are_told(tmp_path, section):
    path = write_yaml(tmp_path, "formula 2", "0 1 0.01", f"{section}:\n    n_is_absolute: true\n")
    with pytest.warns(UserWarning, match=r"own\.yml: n_is_absolute is true"):
        read_refractiveindex_yaml(path)


@pytest.mark.parametrize(
    ("kind", "coefficients", "message"),
    [
        ("formula 1", "0 1 .1 1 .2 1 .3 1 .4", "constant 0 and 4 Sellmeier terms found"),
        ("formula 2", "0.5 1 0.01", "constant 0.5 and 1 Sellmeier terms found"),
        ("formula 2", "0 1 0.01 2", "4 coefficients found, formula 2 has a constant and pairs"),
        ("formula 2", "0 one 0.01", "coefficients must be finite numbers, found '0 one 0.01'"),
        ("formula 2", "0 .nan 0.01", "coefficients must be finite numbers"),
        ("formula 2", "''", "coefficients must be finite numbers, found ''"),
        ("formula 3", "2.3 -0.01 2", "gives n by formula 3; one formula 1 or one formula 2"),
        ("tabulated nk", "0", "gives n by tabulated nk"),
        ("tabulated k", "0", "gives n by no formula"),
    ],
)
def test_other_formulas_are_refused(tmp_path, kind, coefficients, message):
    with pytest.raises(ValueError, match=rf"own\.yml: .*{message}"):
        read_refractiveindex_yaml(write_yaml(tmp_path, kind, coefficients))


def test_several_formulas_are_refused(tmp_path):
    more = "  - type: formula 2\n    coefficients: 0 1 0.01\n"
    with pytest.raises(ValueError, match="gives n by formula 2, formula 2"):
        read_refractiveindex_yaml(write_yaml(tmp_path, "formula 2", "0 1 0.01", more))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"DATA: [", "is not a YAML file"),
        (b"\xff\xfe\x00", "is not a YAML file"),
        (b"", "DATA, a list of entries with a type, is missing"),
        (b"just words", "DATA, a list"),
        (b"DATA: 3", "DATA, a list"),
        (b"DATA:\n  - coefficients: 0 1 0.01\n", "DATA, a list"),
        (b"DATA:\n  - {type: formula 2, coefficients: 0 1 1, wavelength_range: 2 1}", "two rising"),
    ],
)
def test_bad_yaml_is_refused(tmp_path, content, message):
    path = tmp_path / "own.yml"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"own\.yml: .*{message}"):
        read_refractiveindex_yaml(path)


# A name or a file.


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("n-sf11", "N-SF11"),
        (str(FIXTURES / "N-BK7.yml"), "N-BK7"),
        (f"{FIXTURES / 'sample.agf'}:n-sf11", "N-SF11"),
    ],
)
def test_load_glass(text, name):
    assert_same_glass(load_glass(text), named_glass(name), name)


def test_load_glass_takes_a_path():
    assert load_glass(FIXTURES / "N-BK7.yml").name == "N-BK7"


def test_load_glass_wants_one_of_several():
    with (
        pytest.warns(UserWarning, match="WATER"),
        pytest.raises(ValueError, match=r"3 glasses \(N-BK7, F2, N-SF11\).*FILE\.agf:NAME"),
    ):
        load_glass(FIXTURES / "sample.agf")


def test_load_glasses_gives_all():
    with pytest.warns(UserWarning, match="WATER"):
        assert len(load_glasses(FIXTURES / "sample.agf")) == 3


@pytest.mark.parametrize(
    "text", ["missing.agf", "missing.agf:N-BK7", "missing.yml", "missing.yaml"]
)
def test_missing_file_is_named(text):
    with pytest.raises(FileNotFoundError, match=r"missing\.(agf|ya?ml)"):
        load_glass(text)
