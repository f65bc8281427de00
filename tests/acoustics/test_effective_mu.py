"""Materials as rays read them: closed forms, bounds, the frequency where none is given, and what users are told."""

from __future__ import annotations

import numpy as np
import pytest

from mitsonar.acoustics.materials import (
    FLATTEST,
    GRAZING_DEG,
    Material,
    depends_on_frequency,
    hearing_notes,
    material,
    mu_at,
    mu_table,
    normal_mu,
    reference_hz,
    sigma_at,
    sigma_table,
    single_mu,
)

SINE = np.sin(np.radians(np.linspace(0.1, 90, 900)))
TABLE = Material(law="table", strength_db=tuple((-40 + 25 * np.sin(np.radians(GRAZING_DEG))).tolist()))


def test_lambert_is_one_number_and_lommel_seeliger_goes_with_the_sine() -> None:
    np.testing.assert_allclose(mu_at(mu_table(Material(mu=0.1), 1e6), [0.0, *SINE]), 0.1, rtol=1e-14)
    lommel = mu_at(mu_table(Material(law="lommel-seeliger", mu=0.05), 1e6), SINE)
    np.testing.assert_allclose(lommel, 0.05 / SINE, rtol=1e-14)


def test_a_table_is_linear_in_sigma() -> None:
    steep = SINE[SINE > 0.2]
    np.testing.assert_allclose(mu_at(mu_table(TABLE, 1e6), steep) * steep**2, sigma_at(TABLE, steep, 1e6), rtol=1e-12)


@pytest.mark.parametrize("name", ["sand", "gravel", "steel", "wood"])
def test_whole_degrees_meet_the_law(name: str) -> None:
    one, sine = material(name), np.sin(np.radians(GRAZING_DEG[1:]))
    got = mu_at(mu_table(one, 3e5), sine) * sine**2
    np.testing.assert_allclose(got, np.minimum(sigma_table(one, 3e5)[1:], sine), rtol=1e-9)


def test_no_level_exceeds_1() -> None:
    loud = Material(law="table", strength_db=(60.0,) * 91)
    cosine = np.concatenate([[0, 1e-9, FLATTEST / 2], SINE])
    got = mu_at(mu_table(loud, 1e6), cosine)
    assert np.isfinite(got).all()
    assert (got * cosine).max() <= 1 + 1e-12


def test_one_number_for_all_angles() -> None:
    assert single_mu(material("steel")) == material("steel").mu
    assert normal_mu(material("steel"), 1e6) == material("steel").mu
    assert single_mu(TABLE) == pytest.approx(2 * 10 ** (TABLE.strength_db[45] / 10))  # type: ignore[index]
    assert normal_mu(TABLE, 1e6) == pytest.approx(10 ** (-15 / 10))
    assert single_mu(material("sand"), 5e4) == pytest.approx(2 * sigma_table(material("sand"), 5e4)[45])


def test_the_frequency_where_none_is_given() -> None:
    assert reference_hz(material("sand")) == pytest.approx(np.sqrt(10e3 * 100e3))
    assert reference_hz(Material(mu=0.1)) == 100e3
    assert reference_hz(Material(mu=0.1, frequency_max_hz=5e4)) == 5e4
    assert reference_hz(Material(mu=0.1, frequency_min_hz=2e5)) == 2e5
    assert [depends_on_frequency(one) for one in (material("sand"), material("steel"), Material(mu=0.1), TABLE)] == [
        *(True, True, False, False)
    ]


def test_what_users_are_told() -> None:
    assert hearing_notes([material("steel"), Material(mu=0.1), TABLE], 1e6) == []
    assert hearing_notes([Material(mu=0.1), TABLE], None) == []
    (lacking,) = hearing_notes([material("sand")], None)
    assert "no frequency_hz" in lacking
    assert "31.62 kHz" in lacking
    (outside,) = hearing_notes([material("sand")], 1e6)
    assert "1,000 kHz is extrapolated" in outside
    loud = Material(name="loud", law="table", strength_db=(-30.0,) * 80 + (3.0,) * 11)
    (clipped,) = hearing_notes([loud], 1e6)
    assert "material loud" in clipped
    assert "from 80 to 90 deg" in clipped
