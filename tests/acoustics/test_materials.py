"""Materials: closed forms of every law, two routes to one number, bounds of energy, sources, and files that are wrong."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from scipy import integrate
from scipy.special import j0

from mitsonar.acoustics.materials import (
    FLATTEST,
    GRAZING_DEG,
    LARGEST_MU,
    LAWS,
    SEDIMENTS,
    Basis,
    Material,
    Sediment,
    band_warning,
    depends_on_frequency,
    frequency_notes,
    material,
    mirror_amplitude,
    mu_at,
    mu_table,
    named_materials,
    normal_mu,
    reference_hz,
    reflection,
    rough_fluid_sigma,
    roughness_sigma,
    sediment_of,
    sigma_at,
    sigma_table,
    single_mu,
    structure_constant,
    structure_integral,
    volume_sigma,
)
from mitsonar.errors import MitsonarError

ROOT = Path(__file__).resolve().parents[2]
SINE = np.sin(np.radians(GRAZING_DEG))
SAND = Sediment(*(named_materials()["sand"].values[key] for key in LAWS["rough-fluid"]))
TABLE = (-30.0 + 10 * SINE).tolist()


# ---------------------------------------------------------------- Lambert, Lommel-Seeliger, table


def test_lambert_and_lommel_seeliger() -> None:
    np.testing.assert_allclose(sigma_table(Material(mu=0.1), 1e6), 0.1 * SINE**2, rtol=1e-15)
    np.testing.assert_allclose(sigma_table(Material(law="lommel-seeliger", mu=0.05), 1e6), 0.05 * SINE, rtol=1e-15)
    np.testing.assert_allclose(10 * np.log10(sigma_table(Material(law="table", strength_db=TABLE), 1e6)), TABLE)


def test_all_that_arrives_is_scattered_by_the_largest_mu() -> None:
    """A half space of directions: pi mu of Lambert; 4 pi mu (1 - s ln(1 + 1 / s)) of Lommel-Seeliger, most at s = 0."""
    out = np.linspace(0, 1, 200_001)  # sine of the grazing angle of departure
    lambert = integrate.trapezoid(2 * np.pi * LARGEST_MU["lambert"] * out, out)
    assert lambert == pytest.approx(1, rel=1e-9)
    for arrival in (1e-6, 0.3, 1.0):
        one = 2 * LARGEST_MU["lommel-seeliger"] * out / (out + arrival)  # cross-section over the sine of arrival
        scattered = integrate.trapezoid(2 * np.pi * one, out)
        assert scattered == pytest.approx(1 - arrival * math.log(1 + 1 / arrival), rel=1e-4)
        assert scattered <= 1


def test_a_lambert_sphere() -> None:
    """Summed over its lit half by the table: 2 pi a^2 mu / 3."""
    edge = np.linspace(0, 1, 20_001)
    cosine = (edge[1:] + edge[:-1]) / 2
    strength = (sigma_at(Material(mu=0.1), cosine, 1e6) * 2 * np.pi * 0.3**2 * np.diff(edge)).sum()
    assert strength == pytest.approx(2 * np.pi * 0.3**2 * 0.1 / 3, rel=2e-4)


def test_between_whole_degrees_the_table_is_a_line() -> None:
    degrees = np.linspace(0, 90, 1803).reshape(3, -1)
    result = sigma_at(Material(mu=0.3), np.sin(np.radians(degrees)), 1e6)
    assert result.shape == degrees.shape
    np.testing.assert_allclose(result, 0.3 * np.sin(np.radians(degrees)) ** 2, atol=0.3e-4)
    np.testing.assert_allclose(result, np.interp(degrees, GRAZING_DEG, 0.3 * SINE**2), atol=1e-9)
    assert sigma_at(Material(mu=0.3), 1.0, 1e6) == pytest.approx(0.3)
    np.testing.assert_array_equal(sigma_at(Material(mu=0.3), np.array([-0.5, 0.0, 1.5]), 1e6), [0, 0, 0.3])
    assert sigma_at(Material(mu=0.3), np.zeros(0), 1e6).shape == (0,)


def test_tables_cannot_be_written() -> None:
    """They are kept for the next call."""
    with pytest.raises(ValueError, match="read-only"):
        sigma_table(Material(mu=0.3), 1e6)[3] = 1


# ---------------------------------------------------------------- mirror


def test_a_rough_mirror() -> None:
    plate = Material(mu=0.8**2 / math.pi, reflection=0.8, roughness_m=1e-4)
    k = 2 * math.pi * 1e6 / 1500
    np.testing.assert_allclose(mirror_amplitude(plate, SINE, 1e6), 0.8 * np.exp(-2 * (k * 1e-4 * SINE) ** 2), rtol=1e-13)
    assert mirror_amplitude(plate, 1.0, 1e3) == pytest.approx(0.8, rel=1e-6)  # smooth at long waves
    assert mirror_amplitude(Material(mu=0.1), 1.0, 1e6) == 0
    assert plate.has_mirror
    assert not Material(mu=0.1).has_mirror


@pytest.mark.parametrize("frequency", [1e4, 1e5, 3e5, 1e6, 1e7])
def test_mirror_and_rest_return_what_the_reflection_does(frequency: float) -> None:
    """By Lambert's law, of all that arrives: pi sigma / sin^2, and the square of the mirror's amplitude."""
    plate = Material(mu=0.8**2 / math.pi, reflection=0.8, roughness_m=1e-4)
    scattered = math.pi * sigma_table(plate, frequency)[1:] / SINE[1:] ** 2
    np.testing.assert_allclose(scattered + mirror_amplitude(plate, SINE[1:], frequency) ** 2, 0.64, rtol=1e-9)


# ---------------------------------------------------------------- rough fluid


def test_structure_integral_in_closed_form() -> None:
    """alpha = 1/2: q / (1 + q^2)^(3/2)."""
    q = np.geomspace(1e-8, 1e6, 57)
    np.testing.assert_allclose(structure_integral(q, 0.5), q / (1 + q * q) ** 1.5, rtol=1e-10)
    assert structure_integral(np.zeros(1), 0.5)[0] == 0


@pytest.mark.parametrize("alpha", [0.2, 0.45, 0.625, 0.95])
def test_structure_integral_by_a_second_route(alpha: float) -> None:
    """Quadrature where it oscillates little, the first term of both series elsewhere."""
    for q in (0.5, 0.99, 1.01, 3.0):
        end = (40 / q) ** (1 / (2 * alpha))
        if end < 2e3:
            direct = integrate.quad(lambda u, q=q: math.exp(-q * u ** (2 * alpha)) * j0(u) * u, 0, end, limit=20_000)[0]
            assert structure_integral(np.array([q]), alpha)[0] == pytest.approx(direct, rel=1e-6)
    small = 2 ** (1 + 2 * alpha) * alpha * math.gamma(1 + alpha) / math.gamma(1 - alpha) * 1e-9
    assert structure_integral(np.array([1e-9]), alpha)[0] == pytest.approx(small, rel=1e-6)
    large = math.gamma(1 / alpha) / (2 * alpha) * 1e9 ** (-1 / alpha)
    assert structure_integral(np.array([1e9]), alpha)[0] == pytest.approx(large, rel=1e-6)


def test_structure_constant_is_that_of_the_spectrum() -> None:
    """2 int W(K) (1 - cos(K . r)) over the plane: 4 pi w r^(2 alpha) int (1 - J0(u)) u^(1 - gamma) du."""
    alpha = SAND.spectral_exponent / 2 - 1

    def integrand(u: float) -> float:
        return float((1 - j0(u)) * u ** (1 - SAND.spectral_exponent))

    inner = integrate.quad(integrand, 0, 1)[0] + integrate.quad(integrand, 1, 2000, limit=20_000)[0]
    inner += 2000 ** (-2 * alpha) / (2 * alpha)
    assert structure_constant(SAND) == pytest.approx(4 * math.pi * SAND.spectral_strength * inner, rel=1e-4)


def test_little_roughness_is_first_order_perturbation() -> None:
    """4 k^4 sin^4 |Y|^2 W(2 k cos), here for a surface that gives way, where |Y| is 1."""
    smooth = SAND._replace(density_ratio=1e-9, spectral_strength=1e-12)
    angle, k = np.radians([5.0, 20.0, 45.0, 60.0]), 100.0
    spectrum = smooth.spectral_strength * (2 * k * np.cos(angle)) ** -smooth.spectral_exponent
    np.testing.assert_allclose(roughness_sigma(smooth, angle, k), 4 * k**4 * np.sin(angle) ** 4 * spectrum, rtol=1e-4)


def test_straight_down_it_is_kirchhoff_in_closed_form() -> None:
    """|V|^2 / (8 pi) Gamma(1 / alpha) / (2 alpha) (2^(1 - 2 alpha) C^2 k^(2 - 2 alpha))^(-1 / alpha)."""
    alpha, k = SAND.spectral_exponent / 2 - 1, 2 * math.pi * 30e3 / 1500
    slope = 2 ** (1 - 2 * alpha) * structure_constant(SAND) * k ** (2 - 2 * alpha)
    facing = np.array([math.pi / 2])
    spread = math.gamma(1 / alpha) / (2 * alpha) * slope ** (-1 / alpha)
    expected = abs(reflection(SAND, facing)[0]) ** 2 / (8 * math.pi) * spread
    assert roughness_sigma(SAND, facing, k)[0] == pytest.approx(expected, rel=1e-6)


def test_reflection_straight_down() -> None:
    """Impedances: (rho nu - 1) / (rho nu + 1), but for the loss."""
    z = SAND.density_ratio * SAND.sound_speed_ratio
    assert abs(reflection(SAND, np.array([math.pi / 2]))[0]) == pytest.approx((z - 1) / (z + 1), rel=1e-3)
    assert abs(reflection(SAND, np.array([0.0]))[0]) == pytest.approx(1)


def test_volume_by_its_layers() -> None:
    """The sum over layers: what gets in, is scattered, and gets out again by the same way."""
    angle, k = np.radians([30.0, 60.0, 90.0]), 500.0
    below = np.sqrt(((1 + 1j * SAND.loss) / SAND.sound_speed_ratio) ** 2 - np.cos(angle) ** 2)
    into = 1 + reflection(SAND, angle)
    attenuation_db = 20 / math.log(10) * k * SAND.loss / SAND.sound_speed_ratio
    depth = np.linspace(0, 12 / (k * below.imag.min()), 100_001)[:, None]
    through = np.abs(into * into / SAND.density_ratio) ** 2 * np.exp(-4 * k * below.imag * depth)
    summed = integrate.trapezoid(SAND.volume * attenuation_db * through, depth[:, 0], axis=0)
    np.testing.assert_allclose(volume_sigma(SAND, angle), summed, rtol=1e-4)


def test_strengths_of_sea_floors() -> None:
    """In dB at 30 kHz, 20 and 45 deg: -40..-10, and harder ones stronger."""
    floors = ("mud", "sand", "gravel", "rock")
    strengths = {name: 10 * np.log10(sigma_table(material(name), 30e3)[[20, 45]]) for name in floors}
    for result in strengths.values():
        assert ((result > -40) & (result < -10)).all(), strengths
    assert strengths["mud"][1] < strengths["sand"][1] < strengths["gravel"][1] < strengths["rock"][1]


# ---------------------------------------------------------------- named materials


@pytest.mark.parametrize("name", named_materials())
def test_material_is_valid_and_every_number_has_a_source(name: str) -> None:
    one, known = material(name), named_materials()[name]
    assert one.name == name
    assert known.about.strip()
    assert one.basis in get_args(Basis)
    assert all(isinstance(source, str) and len(source.strip()) >= 4 for source in known.sources.values())
    given = {key for key, value in one.model_dump().items() if value != Material.model_fields[key].default}
    assert given - {"name", "about", "source", "law"} <= set(known.sources)
    assert {key: getattr(one, key) for key in known.values} == known.values
    assert all(source in one.source for source in known.sources.values())
    low, high = one.band_hz
    assert band_warning(one, math.sqrt(low * high)) is None
    assert "is extrapolated" in str(band_warning(one, high * 2))
    table = sigma_table(one, math.sqrt(low * high))
    assert np.isfinite(table).all()
    assert (table >= 0).all()


def test_all_that_the_house_needs_is_there() -> None:
    natural = {"mud", "sand", "gravel", "rock", "sand-mhz", "rock-mhz"}
    assert set(named_materials()) >= {*natural, "steel", "concrete", "wood", "rubber"}


@pytest.mark.parametrize("name", ["sand", "rock"])
def test_a_warning_gives_the_band_and_the_material_that_holds(name: str) -> None:
    low, high = material(name), material(f"{name}-mhz")
    assert band_warning(low, 2.1e6) == (
        f"the numbers of material {name} (computed) hold from 10 kHz to 100 kHz: 2,100 kHz is extrapolated; "
        f"give {name}-mhz, which is meant for it"
    )
    assert str(band_warning(high, 50e3)).endswith(f"50 kHz is extrapolated; give {name}, which is meant for it")
    assert [band_warning(high, hz) for hz in (0.1e6, 0.4e6, 1.2e6, 3e6)] == [None] * 4
    assert str(band_warning(high, 4e6)).endswith("4,000 kHz is extrapolated")
    assert str(band_warning(Material(mu=0.1, frequency_max_hz=5e4), 1e5)) == (
        "the numbers of material custom hold to 50 kHz: 100 kHz is extrapolated"
    )


def test_levels_above_100_khz_are_those_of_their_sources() -> None:
    """Sand through its model where that ends, at 30 deg; rock through the middle of what was measured at 20 deg."""
    for frequency in (4e5, 3e6):
        sand, rock = (sigma_table(material(name), frequency) for name in ("sand-mhz", "rock-mhz"))
        assert 10 * math.log10(sand[30] / sigma_table(material("sand"), 100e3)[30]) == pytest.approx(0, abs=0.1)
        assert 10 * math.log10(rock[20]) == pytest.approx(-25, abs=0.1)


def test_grains_that_scatter_alone_are_louder_than_sand() -> None:
    """A bed of independent grains, f^2 / (16 pi chi) sin g, with the functions of Thorne and Meral 2008: by 4 to 7 dB."""
    radius = 0.5e-3 * 2**-1.5
    for frequency in (1.35e6, 1.8e6, 2.1e6, 3e6):
        x = 2 * math.pi * frequency / 1500 * radius
        peaks = (1 - 0.35 * math.exp(-(((x - 1.5) / 0.7) ** 2))) * (1 + 0.5 * math.exp(-(((x - 1.8) / 2.2) ** 2)))
        form = x**2 * peaks / (1 + 0.9 * x**2)
        extinction = 0.29 * x**4 / (0.95 + 1.28 * x**2 + 0.25 * x**4)
        grains = form**2 / (16 * math.pi * extinction) * math.sin(math.radians(30))
        assert 4.0 <= 10 * math.log10(grains / sigma_table(material("sand-mhz"), frequency)[30]) <= 7.0


def test_harder_things_reflect_more_at_every_frequency() -> None:
    """Of what faces the sonar: mirror and rest together are V^2, whatever the roughness."""
    for frequency in (4e5, 1.2e6, 3e6):
        powers = []
        for name in ("rubber", "wood", "concrete", "steel"):
            one = material(name)
            rest = math.pi * sigma_table(one, frequency)[90]
            powers.append(rest + float(mirror_amplitude(one, 1.0, frequency)) ** 2)
            assert powers[-1] == pytest.approx(float(one.reflection or 0) ** 2, rel=0.01)
        assert powers == sorted(powers)


@pytest.mark.parametrize(("name", "density", "speed"), [("steel", 7850.0, 5890.0), ("concrete", 2400.0, 3500.0)])
def test_reflections_are_those_of_impedances(name: str, density: float, speed: float) -> None:
    ratio = density * speed / 1.5e6
    assert (ratio - 1) / (ratio + 1) == pytest.approx(float(material(name).reflection or 0), abs=0.005)


def test_the_materials_are_packaged() -> None:
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    room = ROOT / "mitsonar" / "acoustics"
    packaged = {path for pattern in data["mitsonar.acoustics"] for path in room.glob(pattern)}
    assert packaged == {path for path in room.rglob("*") if path.is_file() and path.suffix not in (".py", ".pyc")}
    assert {path.stem for path in packaged} == set(named_materials())


@pytest.mark.parametrize(("phi", "name"), [(6.0, "mud"), (1.5, "sand"), (-1.0, "gravel")])
def test_sediments_are_those_of_their_grain_size(phi: float, name: str) -> None:
    """Density and speed by grain size in APL-UW TR 9407, as Acoustics Toolbox has them (second hand)."""
    if phi < 1:
        density, speed = 0.007797 * phi**2 - 0.17057 * phi + 2.3139, 0.002709 * phi**2 - 0.056452 * phi + 1.2778
    elif phi < 5.3:
        density = -0.0165406 * phi**3 + 0.2290201 * phi**2 - 1.1069031 * phi + 3.0455
        speed = -0.0014881 * phi**3 + 0.0213937 * phi**2 - 0.1382798 * phi + 1.3425
    else:
        density, speed = -0.0012973 * phi + 1.1565, -0.0024324 * phi + 1.0019
    assert material(name).density_ratio == pytest.approx(density, abs=1e-3)
    assert material(name).sound_speed_ratio == pytest.approx(speed, abs=1e-3)


def test_tables_of_rough_fluids_are_those_of_their_module() -> None:
    expected = rough_fluid_sigma(SAND, np.radians(GRAZING_DEG), 2 * math.pi * 50e3 / 1480)
    np.testing.assert_array_equal(sigma_table(material("sand"), 50e3, 1480.0), expected)


# ---------------------------------------------------------------- libraries


@pytest.mark.learn
@pytest.mark.parametrize("name", ["sand", "steel"])
def test_torch_gives_the_numbers_of_numpy(name: str) -> None:
    """To the bit at whole degrees of the table, else but for the last bits of the arc sine."""
    import torch

    cosine = np.linspace(-0.1, 1.1, 1001).reshape(7, -1)
    for function in (sigma_at, mirror_amplitude):
        expected = function(material(name), cosine, 80e3)
        result = function(material(name), torch.asarray(cosine), 80e3)
        assert result.dtype == torch.float64
        np.testing.assert_allclose(result.numpy(), expected, rtol=1e-11, atol=1e-16)


# ---------------------------------------------------------------- files


def test_a_file_changes_a_named_material(tmp_path: Path) -> None:
    path = tmp_path / "soft.yaml"
    path.write_text("material: mud\nloss: 0.01\n")
    result = material(path)
    assert (result.name, result.loss, result.volume) == ("soft", 0.01, material("mud").volume)
    path.write_text("material: mud\nlaw: lambert\nmu: 0.002\nname: other\n")
    assert material(str(path)).model_dump(exclude_none=True).keys() >= {"mu", "frequency_max_hz"}
    assert (material(path).name, material(path).density_ratio) == ("other", None)
    path.write_text("mu: 0.002\n")
    assert material(path) == Material(name="soft", mu=0.002)
    path.write_text(f"law: table\nstrength_db: {TABLE}\n")
    assert material(path).strength_db == tuple(TABLE)


@pytest.mark.parametrize(("wrong", "near"), [("snd", "sand"), ("Rock", "rock"), ("concret", "concrete")])
def test_unknown_material_names_the_nearest(wrong: str, near: str) -> None:
    with pytest.raises(MitsonarError, match=rf"unknown material '{wrong}': did you mean {near}") as caught:
        material(wrong)
    assert all(name in str(caught.value) for name in named_materials())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mu: [1", "is not YAML"),
        ("- mu\n", "must hold `key: value` lines"),
        ("", "must hold `key: value` lines"),
        ("12: 3\n", "must hold `key: value` lines"),
        ("material: 3\n", "must name a material: got 3"),
        ("material: [sand]\n", "must name a material"),
        ("material: sandd\n", "unknown material 'sandd': did you mean sand"),
        ("law: lambert\n", "law lambert needs mu: it lacks mu"),
        ("law: lamber\nmu: 0.1\n", "did you mean lambert"),
        ("mu: 0.4\n", "material mu: input should be less than or equal to 0.318"),
        ("mu: .nan\n", "material mu: input should be a finite number"),
        ("mu: many\n", "material mu: .*got 'many'"),
        ("muu: 0.1\n", "unknown material key muu: did you mean mu"),
        ("law: lommel-seeliger\nmu: 0.1\n", "at most 0.07958, or more is scattered than arrives: got 0.1"),
        ("mu: 0.2\nreflection: 0.7\nroughness_m: 0.0\n", "at most 0.156, or more is scattered than its reflection returns"),
        ("mu: 0.1\nreflection: 0.9\n", "needs both reflection and roughness_m"),
        ("mu: 0.1\nloss: 0.01\n", "law lambert has no key loss: its keys are mu, reflection, roughness_m"),
        ("material: sand\nreflection: 0.3\nroughness_m: 0.0\n", "law rough-fluid has no key reflection"),
        ("material: sand\nspectral_exponent: 4\n", "spectral_exponent: input should be less than or equal to 3.9"),
        ("law: table\nstrength_db: [1, 2]\n", "strength_db: .*91 items"),
        ("law: table\nstrength_db: -20\n", "strength_db: input should be a valid tuple, got -20"),
        (
            "mu: 0.1\nbasis: guessed\n",
            "basis: .*'measured', 'computed', 'fitted', 'extrapolated' or 'assumed'.*got 'guessed'",
        ),
        ("mu: 0.1\nfrequency_min_hz: 2.0e+5\nfrequency_max_hz: 1.0e+5\n", "frequency_max_hz must exceed frequency_min_hz"),
    ],
)
def test_bad_files(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(MitsonarError, match=message) as caught:
        material(path)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(MitsonarError, match=r"cannot read material file .*absent\.yaml: No such file.*or a material's name"):
        material(tmp_path / "absent.yaml")
    (tmp_path / "sand.txt").write_text("mu: 0.1")
    with pytest.raises(MitsonarError, match=r"ends in \.yaml: got .*sand\.txt"):
        material(tmp_path / "sand.txt")


@pytest.mark.parametrize("value", [0, -1.0, float("nan"), float("inf")])
def test_no_frequency_and_no_speed(value: float) -> None:
    for numbers in ({"frequency_hz": value}, {"frequency_hz": 1e5, "sound_speed_m_s": value}):
        with pytest.raises(MitsonarError, match="must be a finite number above 0"):
            sigma_at(Material(mu=0.1), 1.0, **numbers)
        with pytest.raises(MitsonarError, match="must be a finite number above 0"):
            mirror_amplitude(Material(mu=0.1), 1.0, **numbers)


def test_create_takes_no_nonsense() -> None:
    nonsense: list[dict[str, Any]] = [{"mu": True, "law": []}, {"mu": {}}, {"strength_db": [[1]] * 91}, {"name": 3}]
    for fields in nonsense:
        with pytest.raises(MitsonarError):
            Material.create(**fields)


# ---------------------------------------------------------------- materials as rays read them: closed forms, bounds, the fr

SINES = np.sin(np.radians(np.linspace(0.1, 90, 900)))
TABULATED = Material(law="table", strength_db=tuple((-40 + 25 * np.sin(np.radians(GRAZING_DEG))).tolist()))


def test_lambert_is_one_number_and_lommel_seeliger_goes_with_the_sine() -> None:
    np.testing.assert_allclose(mu_at(mu_table(Material(mu=0.1), 1e6), [0.0, *SINES]), 0.1, rtol=1e-14)
    lommel = mu_at(mu_table(Material(law="lommel-seeliger", mu=0.05), 1e6), SINES)
    np.testing.assert_allclose(lommel, 0.05 / SINES, rtol=1e-14)


def test_a_table_is_linear_in_sigma() -> None:
    steep = SINES[SINES > 0.2]
    np.testing.assert_allclose(
        mu_at(mu_table(TABULATED, 1e6), steep) * steep**2, sigma_at(TABULATED, steep, 1e6), rtol=1e-12
    )


@pytest.mark.parametrize("name", ["sand", "gravel", "steel", "wood"])
def test_whole_degrees_meet_the_law(name: str) -> None:
    one, sine = material(name), np.sin(np.radians(GRAZING_DEG[1:]))
    got = mu_at(mu_table(one, 3e5), sine) * sine**2
    np.testing.assert_allclose(got, np.minimum(sigma_table(one, 3e5)[1:], sine), rtol=1e-9)


def test_no_level_exceeds_1() -> None:
    loud = Material(law="table", strength_db=(60.0,) * 91)
    cosine = np.concatenate([[0, 1e-9, FLATTEST / 2], SINES])
    got = mu_at(mu_table(loud, 1e6), cosine)
    assert np.isfinite(got).all()
    assert (got * cosine).max() <= 1 + 1e-12


def test_one_number_for_all_angles() -> None:
    assert single_mu(material("steel")) == material("steel").mu
    assert normal_mu(material("steel"), 1e6) == material("steel").mu
    assert single_mu(TABULATED) == pytest.approx(2 * 10 ** (TABULATED.strength_db[45] / 10))  # type: ignore[index]
    assert normal_mu(TABULATED, 1e6) == pytest.approx(10 ** (-15 / 10))
    assert single_mu(material("sand"), 5e4) == pytest.approx(2 * sigma_table(material("sand"), 5e4)[45])


def test_one_number_does_not_depend_on_the_mirror_part() -> None:
    """At 100 kHz, 10 um of roughness leave 2e-5 of the power to scattering, which impulse responses multiply by."""
    mirror = {"reflection": 0.9, "roughness_m": 1e-5}
    for law, share in (("lambert", 1.0), ("lommel-seeliger", np.sqrt(2))):
        plain, smooth = (Material.create(law=law, mu=0.05, **more) for more in ({}, mirror))
        assert single_mu(smooth, 1e5) == single_mu(plain, 1e5) == pytest.approx(0.05 * share)


def test_the_frequency_where_none_is_given() -> None:
    assert reference_hz(material("sand")) == pytest.approx(np.sqrt(10e3 * 100e3))
    assert reference_hz(Material(mu=0.1)) == 100e3
    assert reference_hz(Material(mu=0.1, frequency_max_hz=5e4)) == 5e4
    assert reference_hz(Material(mu=0.1, frequency_min_hz=2e5)) == 2e5
    assert [depends_on_frequency(one) for one in (material("sand"), material("steel"), Material(mu=0.1), TABULATED)] == [
        *(True, True, False, False)
    ]


def test_what_users_are_told() -> None:
    assert frequency_notes([material("steel"), Material(mu=0.1), TABULATED], 1e6) == []
    assert frequency_notes([Material(mu=0.1), TABULATED], None) == []
    (lacking,) = frequency_notes([material("sand")], None)
    assert "no frequency_hz" in lacking
    assert "31.62 kHz" in lacking
    (outside,) = frequency_notes([material("sand")], 1e6)
    assert "1,000 kHz is extrapolated" in outside
    loud = Material(name="loud", law="table", strength_db=(-30.0,) * 80 + (3.0,) * 11)
    (clipped,) = frequency_notes([loud], 1e6)
    assert "material loud" in clipped
    assert "from 80 to 90 deg" in clipped


# ---------------------------------------------------------------- sediments by their grain size, against numbers that reach

JACKSON = {  # density, speed, loss, spectral strength in the project hyo2_openbst, after a program of D. R. Jackson
    0.5: (2.231, 1.2503, 0.01638, 2.2e-4),
    1.5: (1.845, 1.1782, 0.01624, 1.406e-4),
    2.5: (1.451, 1.1072, 0.01602, 8.6e-5),
    6.0: (1.149, 0.9873, 0.00386, 1.64e-5),
}


@pytest.mark.parametrize("phi", JACKSON)
def test_the_regressions_meet_numbers_of_another_source(phi: float) -> None:
    result, expected = sediment_of(phi), JACKSON[phi]
    assert (result.density_ratio, result.sound_speed_ratio) == pytest.approx(expected[:2], abs=6e-4)
    assert result.loss == pytest.approx(expected[2], rel=2e-3)
    assert result.spectral_strength == pytest.approx(expected[3], rel=5e-3)


@pytest.mark.parametrize("name", ["sand", "mud"])
def test_named_materials_lie_on_them(name: str) -> None:
    phi = {"sand": 1.5, "mud": 6.0}[name]
    local, result = material(name), sediment_of(phi)
    for key, value in result._asdict().items():
        assert getattr(local, key) == pytest.approx(value, rel=5e-3), key


def test_joints_of_the_regressions_are_small() -> None:
    """Steps where one polynomial ends and the next begins: 10 % at 1 phi (density) and 5 phi (roughness), 2 % elsewhere."""
    for joint, allowed in ((0.0, 0.002), (1.0, 0.11), (2.6, 0.01), (4.5, 0.01), (5.0, 0.1), (5.3, 0.02), (6.0, 0.02)):
        below, above = sediment_of(joint - 1e-9), sediment_of(joint + 1e-9)
        for key in ("density_ratio", "sound_speed_ratio", "loss", "spectral_strength"):
            assert getattr(below, key) == pytest.approx(getattr(above, key), rel=allowed), (joint, key)


def test_coarser_grains_reflect_more() -> None:
    facing = np.array([math.pi / 2])
    result = [abs(reflection(sediment_of(phi), facing)[0]) for phi in SEDIMENTS.values()]
    assert np.all(np.diff(result) < 1e-3)
    assert 0.3 < result[2] < 0.55
    assert result[-1] < 0.1


def test_a_file_names_the_grain_size(tmp_path: Path) -> None:
    path = tmp_path / "fine.yaml"
    path.write_text("grain_size_phi: 2.5\n")
    result = material(path)
    assert (result.law, result.name) == ("rough-fluid", "fine")
    assert (result.loss, result.spectral_exponent) == (sediment_of(2.5).loss, 3.25)
    assert result.band_hz == (10e3, 100e3)
    assert np.isfinite(sigma_table(result, 50e3)).all()
    path.write_text("grain_size_phi: 2.5\nloss: 0.02\n")
    assert material(path).loss == 0.02
    assert material(path).density_ratio == sediment_of(2.5).density_ratio


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("grain_size_phi: 9.5\n", r"must lie in -1\.\.9, sandy gravel to clay: got 9\.5"),
        ("grain_size_phi: .nan\n", r"must lie in -1\.\.9"),
        ("grain_size_phi: fine\n", "grain_size_phi in .* must be a number: got 'fine'"),
        ("grain_size_phi: true\n", "must be a number: got True"),
        ("grain_size_phi: 2\nmaterial: sand\n", "grain_size_phi and material both set the parameters"),
        ("grain_size_phi: 2\nlaw: lambert\nmu: 0.1\n", "law lambert has no key"),
    ],
)
def test_bad_grain_sizes(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(MitsonarError, match=message):
        material(path)
