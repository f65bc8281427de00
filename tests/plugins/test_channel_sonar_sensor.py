"""The instrument of impulse responses: its numbers, its fields of view, its XML."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from helpers import MitsubaDict

from mitsonar.errors import MitsonarError
from mitsonar.instruments.hydrophones import ChannelSonar, FieldOfView, four_receivers

ROWS = {(4.8e3, 8e3): 800, (9.6e3, 16e3): 1600, (19.2e3, 32e3): 3200}


@pytest.mark.parametrize(("band", "taps"), ROWS.items())
def test_taps_of_the_thesis(band: tuple[float, float], taps: int) -> None:
    sonar = ChannelSonar(bandwidth_hz=band[0], sampling_hz=band[1])
    assert sonar.taps == taps == len(sonar.delay_s)
    assert sonar.delay_s[1] == 1 / band[1]


@pytest.mark.parametrize("rolloff", [0.0, 0.25, 0.5, 1.0])
def test_raised_cosine_and_pulse_are_one(rolloff: float) -> None:
    """Eq. 5.16, corrected, and its inverse transform in closed form; at alpha = 0 the sum over frequencies ends abruptly."""
    sonar = ChannelSonar(bandwidth_hz=4e3, rolloff=rolloff)
    frequency = np.fft.fftfreq(160_000, 1 / 8000)
    shape = sonar.raised_cosine(frequency)
    assert shape[0] == 1
    assert shape[np.abs(frequency) > (1 + rolloff) * 2e3].max(initial=0) == 0
    if rolloff:
        assert shape[np.abs(np.abs(frequency) - 2e3) < 1e-9] == pytest.approx(0.5)
    expected = np.fft.ifft(shape)[:200].real
    assert np.abs(expected - sonar.pulse(np.arange(200) / 8000)).max() < (1e-8 if rolloff else 1e-4)


def test_four_receivers_look_away_from_the_transmitter() -> None:
    for receiver in four_receivers():
        middle = receiver.field.axes[0]
        level = np.array(receiver.position) / 0.1
        assert np.linalg.norm(level) == pytest.approx(1)
        assert middle @ level == pytest.approx(np.sin(np.radians(25)))
        assert middle[2] == pytest.approx(-np.cos(np.radians(25)))
        assert np.allclose(receiver.field.axes @ receiver.field.axes.T, np.eye(3), atol=1e-12)
    names = [receiver.name for receiver in four_receivers()]
    assert names == ["front", "left", "back", "right"]


def at(field: FieldOfView, across_deg: float, along_deg: float) -> float:
    """Sensitivity to a direction by its angles."""
    across, along = np.radians([across_deg, along_deg])
    return float(field.sensitivity(np.cos(across) * np.cos(along), np.sin(across), np.cos(across) * np.sin(along)))


def test_sensitivity_falls_smoothly_to_the_edges() -> None:
    field = FieldOfView(taper=0.4)
    assert at(field, 0, 0) == at(field, 2.9, 0) == at(field, 0, -14.9) == 1
    assert at(field, 4, 0) == pytest.approx(0.5)
    assert at(field, 0, 20) == pytest.approx(0.5)
    assert at(field, 4, 20) == pytest.approx(0.25)
    assert at(field, 5.01, 0) == at(field, 0, 25.1) == at(field, 170, 0) == 0
    hard = FieldOfView(taper=0)
    assert at(hard, 4.99, 24.99) == 1
    assert at(hard, 5.01, 0) == 0
    circle = FieldOfView(shape="circular", taper=0)
    assert at(circle, 3.4, 3.4) == 1
    assert at(circle, 3.6, 3.6) == 0
    assert at(FieldOfView(shape="all"), 170, 80) == 1


BAD: list[tuple[MitsubaDict, str]] = [
    ({"carrier_hz": 0}, "carrier_hz must exceed half the band"),
    ({"carrier_hz": 3000}, "carrier_hz must exceed half the band"),
    ({"bandwidth_hz": 9.6e3}, r"sampling_hz must be at least \(1 \+ rolloff\) bandwidth_hz = 14400 Hz"),
    ({"frequency_step_hz": 20}, "frequency_step_hz must be below .* = 15 Hz"),
    ({"frequency_step_hz": 7}, "sampling_hz must be a whole number of frequency_step_hz"),
    ({"receivers": ()}, "receivers"),
    ({"receivers": four_receivers()[:1] * 2}, "different names"),
    ({"receivers": [{"name": "a b"}]}, "letters, digits"),
    ({"receivers": [{"name": "a", "position": (0, 0, np.inf)}]}, "position must be finite"),
    ({"receivers": [{"name": "a", "field": {"across_deg": 0}}]}, "across_deg"),
    ({"carier_hz": 80e3}, "carrier_hz"),
    ({"carrier_hz": float("nan")}, "carrier_hz"),
    ({"model": "points"}, "scatterers"),
]


@pytest.mark.parametrize(("fields", "said"), BAD)
def test_bad_values_are_one_sentence(fields: MitsubaDict, said: str) -> None:
    with pytest.raises(MitsonarError, match=said) as error:
        ChannelSonar.create(**fields)
    assert "\n" not in str(error.value).strip()


def test_the_step_that_would_do_does() -> None:
    with pytest.raises(MitsonarError, match="give ") as error:
        ChannelSonar.create(frequency_step_hz=20, range_max=30)
    step = float(str(error.value).split("give ")[1].split(" Hz")[0])
    assert ChannelSonar.create(frequency_step_hz=step, range_max=30).taps == round(8000 / step)


def test_it_is_plain_values_and_back() -> None:
    sonar = ChannelSonar(carrier_hz=160e3, receivers=four_receivers(0.2, across_deg=2.0)[:2])
    assert ChannelSonar.create(**sonar.model_dump(mode="json")) == sonar
    assert sonar.replace(carrier_hz=80e3).receivers == sonar.receivers


# ---------------------------------------------------------------- XML

XML = """<scene version="3.0.0"><sensor type="channel_sonar">{}
    <transform name="to_world"><lookat origin="1, 2, 10" target="2, 2, 10" up="0, 0, 1"/></transform></sensor></scene>"""


def from_xml(properties: str) -> Any:
    import mitsuba as mi

    from mitsonar.simulation.scene import channel_sonar_in

    return channel_sonar_in(mi.load_string(XML.format(properties), parallel=False))


@pytest.mark.usefixtures("variant")
def test_properties_of_the_sensor() -> None:
    sonar, pose = from_xml("""
        <string name="receivers" value="front, mast"/>
        <float name="carrier_hz" value="160000"/> <integer name="bandwidth_hz" value="4000"/>
        <boolean name="spreading" value="false"/> <float name="across_deg" value="4"/>
        <string name="mast_shape" value="circular"/> <float name="mast_heading_deg" value="45"/>
        <point name="mast_position" x="0.5" y="0" z="1"/> <float name="transmitter_across_deg" value="120"/>
        <string name="transmitter_shape" value="circular"/>""")
    front, mast = sonar.receivers
    assert (sonar.carrier_hz, sonar.bandwidth_hz, sonar.spreads) == (160e3, 4e3, False)
    assert front == four_receivers(across_deg=4.0)[0]
    assert (mast.position, mast.field.heading_deg, mast.field.shape, mast.field.across_deg) == (
        (0.5, 0, 1),
        45,
        "circular",
        4,
    )
    assert (sonar.transmitter.shape, sonar.transmitter.across_deg) == ("circular", 120)
    assert np.allclose(pose, (1, 2, 10, 0, 0, np.pi / 2))


@pytest.mark.usefixtures("variant")
def test_defaults_of_the_sensor_are_the_thesis() -> None:
    assert from_xml("")[0] == ChannelSonar()


@pytest.mark.usefixtures("variant")
@pytest.mark.parametrize(
    ("properties", "said"),
    [
        ('<string name="receivers" value="mast"/>', "mast_heading_deg"),
        ('<float name="carrier_hz" value="0"/>', "carrier_hz must exceed"),
        ('<float name="frequency_step_hz" value="20"/>', "frequency_step_hz must be below"),
        ('<float name="fronts_across_deg" value="3"/>', "did you mean front_across_deg"),
        ('<float name="carier_hz" value="3"/>', "did you mean carrier_hz"),
        ('<string name="receivers" value="front right"/>', "separated by commas"),
        ('<string name="receivers" value="keel"/><float name="keel_heading_deg" value="3"/>', "give keel_position "),
        ('<string name="front_position" value="0, ahead, 0"/>', "front_position must be a point"),
    ],
)
def test_mistakes_in_xml_are_answered(properties: str, said: str) -> None:
    with pytest.raises(RuntimeError, match=said):
        from_xml(properties)


@pytest.mark.usefixtures("variant")
def test_as_a_camera_it_sends_one_ray_forward() -> None:
    import mitsuba as mi

    scene = mi.load_string(XML.format(""), parallel=False)
    half = mi.Point2f(0.5)
    for method in ("sample_ray", "sample_ray_differential"):
        ray, weight = getattr(scene.sensors()[0], method)(mi.Float(0.25), mi.Float(0.5), half, half)
        np.testing.assert_allclose(np.ravel(ray.o), [1, 2, 10], atol=1e-6)
        np.testing.assert_allclose(np.ravel(ray.d), [1, 0, 0], atol=1e-6)
        assert float(np.ravel(ray.time)[0]) == 0.25
        assert float(np.ravel(ray.maxt)[0]) > 1e30
        assert (np.ravel(weight) == 1).all()
