"""Sonars that can be named: every number of a preset with the document it comes from.

``(not seen)`` marks a number that is widely quoted from a data sheet which could not be read when this was written,
``second hand`` one that a third party quotes from the named sheet, ``ours`` a choice. Real instruments measure the
angle to a line array (``bearing: cone``); windows are set by the user of the instrument, so a preset's window is ours,
inside the instrument's limits.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mitsonar.errors import MitsonarError, nearest_names
from mitsonar.instruments.imaging_sonar import Sonar
from mitsonar.io.whole_files import read_yaml

__all__ = ["PRESETS", "load_sonar", "preset", "preset_sources", "sonar_from"]

DIDSON = "Sound Metrics, web page `DIDSON Resolution` (soundmetrics.com/SONAR101/resolution.html)"
DIDSON_SHEET = "BCO-DMO instrument page 892128 after the Sound Metrics DIDSON data sheet"
ARIS = "Sound Metrics, aris-integration-sdk, SystemConfiguration_Definitions.cs"
ARIS_SHEET = "Sound Metrics, ARIS Explorer 3000 specifications (not seen)"
P900 = "Teledyne BlueView, P900 Series 2D Imaging Sonar data sheet (not seen)"
P900_DAVE = "DAVE documentation, Multibeam Forward-Looking Sonar, after the P900 data sheet"
OCULUS = "Blueprint Subsea, Oculus M-Series data sheet DA-148-P01443, second hand"
OCULUS_SHEET = "Blueprint Subsea, Oculus M-Series data sheet DA-148-P01443 (not seen)"
OCULUS_RATE = "Blueprint Subsea, Oculus M-Series brochure (the series as a whole)"
OCULUS_SINE = "bearing table in recorded M1200d pings: equal steps of the sine (other modes: inferred from it)"
GEMINI = "Tritech, Gemini 720is Product Manual 0703-SOM-00002, section 2.1"
GEMINI_SHEET = "Tritech, Gemini 720is data sheet 0703-SOM-00001, second hand"
GEMINI_SINE = "bearing table of a Gemini log: 512 equal steps of the sine"
THESIS = "Almanza-Medina, section 2.3"
THESIS4 = "Almanza-Medina, chapter 4"
LINE_ARRAY = "a line array or acoustic lens measures the angle to its own axis"
WINDOW = "ours, inside the instrument's limits"
TVG = "ours: spreading is compensated, as instruments show it"

PRESETS: dict[str, tuple[str, dict[str, tuple[Any, str]]]] = {
    "didson300": (
        "Sound Metrics DIDSON 300, identification mode (1.8 MHz)",
        {
            "azimuth_fov_deg": (29.0, DIDSON_SHEET),
            "elevation_fov_deg": (14.0, DIDSON),
            "beams": (96, DIDSON),
            "beam_width_deg": (0.3, DIDSON),
            "range_min": (3.2, WINDOW),
            "range_max": (5.6, WINDOW),
            "range_bins": (512, DIDSON),
            "frame_rate_hz": (21.0, DIDSON_SHEET),
            "bearing": ("cone", LINE_ARRAY),
            "thesis_rays": (700, THESIS),
            "gain_exponent": (2, TVG),
        },
    ),
    "aris3000": (
        "Sound Metrics ARIS Explorer 3000, identification mode (3.0 MHz)",
        {
            "azimuth_fov_deg": (30.25, "ARIS beam table aris3000_128 (Sound Metrics aris-file-sdk), edge to edge"),
            "elevation_fov_deg": (15.0, ARIS_SHEET),
            "beams": (128, ARIS),
            "beam_width_deg": (0.2, ARIS_SHEET),
            "range_min": (0.7, ARIS),
            "range_max": (5.0, ARIS),
            "range_bins": (1344, "bins of a recorded ARIS 3000 window (0.003 m steps, the SDK's finest)"),
            "frame_rate_hz": (15.0, ARIS),
            "bearing": ("cone", LINE_ARRAY),
            "gain_exponent": (2, TVG),
        },
    ),
    "lookdown100": (
        "the thesis's looking-down sonar",
        {
            "azimuth_fov_deg": (100.0, THESIS4),
            "elevation_fov_deg": (100.0, THESIS4),
            "beams": (1000, THESIS4),
            "range_min": (2.0, THESIS4),
            "range_max": (6.1, THESIS4),
            "range_bins": (512, THESIS4),
            "bearing": ("azimuth", "gives the thesis's windows of 6.1 and 24.5 m"),
            "thesis_rays": (1000, THESIS4),
            "gain_exponent": (2, "ours: the thesis has an implicit R^2 gain"),
        },
    ),
    "blueview-p900-45": (
        "Teledyne BlueView P900-45 (900 kHz)",
        {
            "azimuth_fov_deg": (45.0, "the instrument's name; P900 Series 2D Imaging Sonar data sheet (not seen)"),
            "elevation_fov_deg": (20.0, P900_DAVE),
            "beams": (256, P900),
            "beam_width_deg": (1.0, P900),
            "range_min": (2.0, P900_DAVE),
            "range_max": (40.0, "ours, inside the optimal 2..60 m of the DAVE documentation"),
            "range_bins": (1496, "0.0254 m bins, as published P900 simulations take from the data sheet"),
            "frame_rate_hz": (15.0, P900),
            "bearing": ("cone", LINE_ARRAY),
            "gain_exponent": (2, TVG),
        },
    ),
    "blueview-p900-130": (
        "Teledyne BlueView P900-130 (900 kHz)",
        {
            "azimuth_fov_deg": (130.0, "Aracati 2017 data set, README: P900-130, 130 deg"),
            "elevation_fov_deg": (20.0, P900_DAVE),
            "beams": (768, P900),
            "beam_width_deg": (1.0, P900),
            "range_min": (2.0, P900_DAVE),
            "range_max": (40.0, "ours, inside the optimal 2..60 m of the DAVE documentation"),
            "range_bins": (1496, "0.0254 m bins, as published P900 simulations take from the data sheet"),
            "frame_rate_hz": (15.0, P900),
            "bearing": ("cone", LINE_ARRAY),
            "gain_exponent": (2, TVG),
        },
    ),
    "oculus-m750d-750khz": (
        "Blueprint Subsea Oculus M750d, 750 kHz (limits 0.1..120 m)",
        {
            "azimuth_fov_deg": (130.0, OCULUS),
            "elevation_fov_deg": (20.0, OCULUS),
            "beams": (512, OCULUS),
            "beam_layout": ("sine", OCULUS_SINE),
            "beam_width_deg": (1.0, OCULUS_SHEET),
            "range_min": (1.0, WINDOW),
            "range_max": (40.0, WINDOW),
            "range_bins": (1024, "ours; the data sheet's range resolution is finer"),
            "frame_rate_hz": (40.0, OCULUS_RATE),
            "bearing": ("cone", LINE_ARRAY),
            "gain_exponent": (2, TVG),
        },
    ),
    "oculus-m750d-1200khz": (
        "Blueprint Subsea Oculus M750d, 1.2 MHz (limits 0.1..40 m)",
        {
            "azimuth_fov_deg": (130.0, "DA-148-P01443, second hand; other sources say 70 or 80: unconfirmed"),
            "elevation_fov_deg": (20.0, OCULUS),
            "beams": (512, OCULUS),
            "beam_layout": ("sine", OCULUS_SINE),
            "beam_width_deg": (0.6, OCULUS),
            "range_min": (0.5, WINDOW),
            "range_max": (20.0, WINDOW),
            "range_bins": (1024, "ours; the data sheet's range resolution is finer"),
            "frame_rate_hz": (40.0, OCULUS_RATE),
            "bearing": ("cone", LINE_ARRAY),
            "gain_exponent": (2, TVG),
        },
    ),
    "oculus-m1200d-1200khz": (
        "Blueprint Subsea Oculus M1200d, 1.2 MHz (limits 0.1..40 m)",
        {
            "azimuth_fov_deg": (130.0, OCULUS),
            "elevation_fov_deg": (20.0, OCULUS),
            "beams": (512, OCULUS),
            "beam_layout": ("sine", OCULUS_SINE),
            "beam_width_deg": (0.6, OCULUS),
            "range_min": (0.5, WINDOW),
            "range_max": (20.0, WINDOW),
            "range_bins": (1024, "ours; the data sheet's range resolution is finer"),
            "frame_rate_hz": (40.0, OCULUS_RATE),
            "bearing": ("cone", LINE_ARRAY),
            "gain_exponent": (2, TVG),
        },
    ),
    "oculus-m1200d-2100khz": (
        "Blueprint Subsea Oculus M1200d, 2.1 MHz (limits 0.1..10 m)",
        {
            "azimuth_fov_deg": (60.0, "recorded M1200d pings, and data sheet DA-148-P01443, second hand"),
            "elevation_fov_deg": (12.0, OCULUS),
            "beams": (512, OCULUS),
            "beam_layout": ("sine", OCULUS_SINE),
            "beam_width_deg": (0.4, OCULUS),
            "range_min": (0.3, WINDOW),
            "range_max": (10.0, WINDOW),
            "range_bins": (1024, "ours; the data sheet's range resolution is finer"),
            "frame_rate_hz": (40.0, OCULUS_RATE),
            "bearing": ("cone", LINE_ARRAY),
            "gain_exponent": (2, TVG),
        },
    ),
    "gemini-720is": (
        "Tritech Gemini 720is (720 kHz; limits 0.1..120 m; the head tilts its array 10 deg down)",
        {
            "azimuth_fov_deg": (120.0, GEMINI),
            "elevation_fov_deg": (20.0, GEMINI),
            "beams": (512, GEMINI_SHEET),
            "beam_layout": ("sine", GEMINI_SINE),
            "beam_width_deg": (1.0, GEMINI),
            "range_min": (1.0, WINDOW),
            "range_max": (40.0, WINDOW),
            "range_bins": (1024, "ours; the data sheet's range resolution is 4 mm (CHIRP), second hand"),
            "frame_rate_hz": (30.0, GEMINI),
            "bearing": ("cone", LINE_ARRAY),
            "gain_exponent": (2, TVG),
        },
    ),
}
"""What each preset is, and its numbers with their sources, by name."""


def preset(name: str) -> Sonar:
    """The sonar of a preset.

    Raises:
        MitsonarError: unknown name, with the nearest ones.
    """
    if name not in PRESETS:
        raise MitsonarError(f"unknown sonar preset {name!r}: {nearest_names(name, PRESETS)}")
    _, numbers = PRESETS[name]
    return Sonar.create(name=name, **{key: value for key, (value, _) in numbers.items()})


def preset_sources(name: str) -> dict[str, str]:
    """Where each number of a preset comes from; numbers of rays follow from ``quality`` and have no source."""
    preset(name)
    return {key: source for key, (_, source) in PRESETS[name][1].items()}


def load_sonar(name_or_file: str | Path) -> Sonar:
    """A preset by its name, or a sonar from a YAML file (keys: the fields of :class:`Sonar`, and ``preset``).

    Raises:
        MitsonarError: unknown preset (with the nearest names), unreadable file, unknown key, value out of limits.
    """
    text = str(name_or_file)
    if not text.lower().endswith((".yaml", ".yml")):
        if text in PRESETS or not Path(text).exists():
            return preset(text)
        raise MitsonarError(f"a sonar's file ends in .yaml: got {text}; rename it, or name a preset")
    try:
        fields = read_yaml(text, "sonar file")
    except MitsonarError as error:
        more = "; see docs/guides/sonars.md" if "not YAML" in str(error) else " or a preset's name"
        raise MitsonarError(f"{error}{more}") from None
    if not isinstance(fields, dict) or not all(isinstance(key, str) for key in fields):
        raise MitsonarError(f"{text} must hold `key: value` lines of a sonar; see docs/guides/sonars.md")
    fields.setdefault("name", Path(text).stem)
    return sonar_from(fields)


def sonar_from(fields: dict[str, Any]) -> Sonar:
    """A sonar from its fields, the key ``preset`` (optional) naming the one they change."""
    fields = dict(fields)
    base = fields.pop("preset", None)
    if not all(isinstance(key, str) for key in fields) or not isinstance(base, str | None):
        raise MitsonarError("the keys of a sonar must be words, and preset the name of one; see docs/guides/sonars.md")
    return Sonar.create(**fields) if base is None else preset(str(base)).replace(**fields)
