"""How is the geometry of pictures described and checked? By YAML files, and by the outline of fans in the pictures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from mitsonar.errors import MitsonarError, validation_message
from mitsonar.instruments.sonar import Bearing, Coding
from mitsonar.io.files import read_yaml

__all__ = ["Outline", "PictureGeometry", "doubts", "find_geometry_file", "load_geometry", "outline_of"]


ANY_RANGE_MAX = 10.0
"""End of the window if the metric scale is unknown [m]; the value is arbitrary."""

ANY_ELEVATION_DEG, ANY_RATE_HZ = 14.0, 10.0
"""Elevation aperture [deg] and frame rate [Hz] that are assumed if they are not given."""

SCALE_TOLERANCE = 0.02
"""Difference between ``near_px / far_px`` and ``range_min / range_max`` beyond which the apex is questioned."""

FAN = ("apex_px", "near_px", "far_px", "half_angle_deg")
"""Keys that a fan requires."""

FAN_ONLY = (*FAN, "stretch", "forward", "pixels_per_m", "bins", "beams")
POLAR_ONLY = ("azimuth_fov_deg", "bearings_deg", "beam_layout", "rows", "transposed")
"""Keys that are valid for one layout only."""

SEE = "; see docs/reference/files.md#geometry-files"

Row = tuple[float, float]


class PictureGeometry(BaseModel):
    """Layout of the pictures of a recording; each field is a key of the YAML file.

    Pixel coordinates are 0 at the centre of the upper left pixel; columns increase to the right, rows downwards. Pixel
    (u, v) of a fan lies at x = (u - apex column) ``stretch`` to the right and y = apex row - v forward.

    Raises:
        MitsonarError: by :meth:`create`, for an unknown key or inconsistent values.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    layout: Literal["fan", "polar"] = Field(description="fan: scan-converted pictures; polar: beams by bins")
    name: str = Field("pictures", max_length=200, description="name of the sonar")
    apex_px: Row | None = Field(None, description="fan: column and row of the sonar; may lie outside the picture")
    near_px: float | None = Field(None, ge=0, le=1e6, description="fan: distance of the near arc from the apex [px]")
    far_px: float | None = Field(None, gt=0, le=1e6, description="fan: distance of the far arc from the apex [px]")
    half_angle_deg: float | None = Field(None, gt=0, le=180, description="fan: angle from its axis to its edge [deg]")
    stretch: float = Field(1.0, gt=0.01, lt=100, description="fan: factor on columns that makes its arcs circles")
    forward: Literal["up", "down"] = Field("up", description="fan: whether ranges rise upwards or downwards")
    pixels_per_m: float | None = Field(None, gt=0, le=1e6, description="fan: scale, in place of range_max [px/m]")
    bins: int | None = Field(None, ge=2, le=65_536, description="fan: range bins to make; default: one a pixel")
    beams: int | None = Field(None, ge=2, le=65_536, description="fan: beams to make; default: one a pixel at mid range")
    azimuth_fov_deg: float | None = Field(None, gt=0, le=360, description="polar: field of view over all beams [deg]")
    bearings_deg: tuple[float, ...] | None = Field(
        None, min_length=2, max_length=65_536, description="polar: bearing of each column, starboard positive [deg]"
    )
    beam_layout: Literal["even", "sine"] = Field("even", description="polar: steps of the angle, or of its sine")
    rows: Literal["near-to-far", "far-to-near"] = Field("near-to-far", description="polar: order of the rows")
    transposed: bool = Field(False, description="polar: each row is a beam, each column a bin")
    mirror: bool = Field(False, description="left in the picture is starboard")
    range_min: float | None = Field(None, ge=0, le=1e5, description="start of the window [m]; fan: default by near_px")
    range_max: float | None = Field(None, gt=0, le=1e5, description="end of the window [m]")
    scale_known: bool = Field(True, description="false: metres are not known, and range_max may be any value")
    level: Coding | None = Field(None, description="how values represent levels: linear, dB or gamma; default: linear")
    coding_db: float = Field(80.0, gt=0, le=300, description="span of the level dB, from value 0 to 255 [dB]")
    coding_gamma: float = Field(0.5, gt=0, le=4, description="exponent of the level gamma: value = amplitude^gamma")
    sound_speed: float = Field(1500.0, gt=0, le=1e4, description="sound speed [m/s]")
    frame_rate_hz: float | None = Field(None, gt=0, le=1e6, description="pictures per second, for pictures without times")
    times: str | None = Field(None, description="file of times [s], a line each, `TIME` or `NAME, TIME`")
    pitch_deg: float | None = Field(None, ge=-90, le=90, description="pitch of the sonar [deg], > 0 is down")
    roll_deg: float = Field(0.0, ge=-180, le=180, description="roll of the sonar [deg], > 0 is starboard down")
    height_m: float | None = Field(None, gt=0, le=1e5, description="height of the sonar over the ground [m]")
    frequency_hz: float | None = Field(None, gt=0, le=1e8, description="carrier [Hz]")
    elevation_fov_deg: float | None = Field(None, gt=0, le=180, description="field of view within a beam [deg]")
    bearing: Bearing | None = Field(
        None, description="meaning of a beam's angle: azimuth, or the cone of a line array; default: cone up to 180 deg"
    )

    @classmethod
    def create(cls, **fields: Any) -> Self:  # values of a file, before pydantic checks them
        """Create a geometry from its keys.

        Raises:
            MitsonarError: if a key is unknown, a value is outside its limits, or keys are inconsistent.
        """
        try:
            return cls(**fields)
        except ValidationError as error:
            raise MitsonarError(validation_message(error, cls, "geometry", SEE)) from None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        others = POLAR_ONLY if self.layout == "fan" else FAN_ONLY
        wrong = [name for name in others if name in self.model_fields_set]
        if wrong:
            raise ValueError(f"{', '.join(wrong)} do not apply to the layout {self.layout}: omit them{SEE}")
        self._check_fan() if self.layout == "fan" else self._check_polar()
        if self.range_min is not None and self.range_max is not None and not self.range_max > self.range_min:
            raise ValueError(f"range_max must exceed range_min: got {self.range_max:g} m <= {self.range_min:g} m")
        return self

    def _check_fan(self) -> None:
        missing = [name for name in FAN if getattr(self, name) is None]
        if missing:
            raise ValueError(f"the layout fan needs {', '.join(missing)}{SEE}")
        if not self.far >= self.near + 2:
            raise ValueError(f"far_px must exceed near_px by 2: got {self.far:g} and {self.near:g}")
        scales = (self.pixels_per_m is not None) + (self.range_max is not None)
        if scales == 2 or (scales == 0 and self.scale_known):
            raise ValueError("a fan needs its scale: give either pixels_per_m or range_max, or `scale_known: false`")

    def _check_polar(self) -> None:
        if self.range_min is None or self.range_max is None:
            raise ValueError("the layout polar needs range_min and range_max; with `scale_known: false` their ratio counts")
        if (self.azimuth_fov_deg is None) == (self.bearings_deg is None):
            raise ValueError("the layout polar needs either azimuth_fov_deg or bearings_deg")
        if self.bearings_deg is not None:
            steps = [after - before for before, after in zip(self.bearings_deg, self.bearings_deg[1:], strict=False)]
            if not (all(step > 0 for step in steps) or all(step < 0 for step in steps)):
                raise ValueError("bearings_deg must increase, or decrease, from column to column")
            if not all(abs(one) <= 180 for one in self.bearings_deg):
                raise ValueError("bearings_deg must lie in -180..180 deg")
            if {"mirror", "beam_layout"} & self.model_fields_set:
                raise ValueError("bearings_deg determine the order of the columns: omit mirror and beam_layout")

    @property
    def near(self) -> float:
        """Return ``near_px`` of a fan; 0 if it is not given."""
        return float(self.near_px or 0.0)

    @property
    def far(self) -> float:
        """Return ``far_px`` of a fan; 0 if it is not given."""
        return float(self.far_px or 0.0)

    @property
    def window_m(self) -> Row:
        """Return the start and end of the window [m]."""
        if self.layout == "polar":
            return float(self.range_min or 0.0), float(self.range_max or 0.0)
        scale = self.pixels_per_m
        end = float(self.range_max or ANY_RANGE_MAX) if scale is None else self.far / scale
        start = self.near * end / self.far if self.range_min is None else float(self.range_min)
        return start, end

    def bearing_of(self, half_angle_deg: float) -> Bearing:
        """Return the meaning of a beam's angle: as given, or cone for half angles of the fan up to 90 deg, else azimuth."""
        return self.bearing or ("cone" if half_angle_deg <= 90 else "azimuth")

    def notes(self) -> list[str]:
        """Return sentences on what is assumed."""
        start, end = self.window_m
        notes = []
        if not self.scale_known:
            notes.append(f"metres are not known: the window counts as {start:.4g}..{end:.4g} m, and lengths are up to scale")
        if self.layout == "fan" and abs(self.near / self.far - start / end) > SCALE_TOLERANCE:
            notes.append(
                f"near_px and far_px are {self.near:g} and {self.far:g}, and range_min and range_max {start:g} and {end:g} "
                "m: the ratios differ, check the apex"
            )
        if self.level is None:
            notes.append("level is not given: values are assumed to be linear")
        if self.elevation_fov_deg is None:
            notes.append(f"elevation_fov_deg is not given: {ANY_ELEVATION_DEG:g} deg are assumed")
        return notes


def load_geometry(path: str | Path) -> PictureGeometry:
    """Load a geometry file.

    Raises:
        MitsonarError: if the file does not exist or is not YAML, a key is unknown, or values are inconsistent.
    """
    fields = read_yaml(path, "geometry file")
    if not isinstance(fields, dict) or not all(isinstance(key, str) for key in fields):
        raise MitsonarError(f"{path} must hold `key: value` lines of a geometry{SEE}")
    try:
        geometry = PictureGeometry.create(**fields)
    except MitsonarError as error:
        raise MitsonarError(f"{path}: {error}") from None
    numbers = [value for value in geometry.model_dump().values() if isinstance(value, float)]
    if not all(map(math.isfinite, [*numbers, *(geometry.apex_px or ()), *(geometry.bearings_deg or ())])):
        raise MitsonarError(f"{path} holds a number that is not finite{SEE}")
    return geometry


def find_geometry_file(path: Path) -> Path | None:
    """Return the geometry file that belongs to a recording; None if there is none.

    It is ``geometry.yaml`` in a folder, or else ``FILE.yaml`` or ``geometry.yaml`` next to the file or folder.
    """
    path = path.absolute()
    candidates = [path / "geometry.yaml"] if path.is_dir() else []
    if not path.name:  # the root of the file system
        return None
    candidates += [path.with_name(f"{path.name}.yaml"), path.with_suffix(".yaml"), path.with_name("geometry.yaml")]
    return next((one for one in candidates if one.is_file() and one != path), None)


# ---------------- Check of a geometry by the outline of a fan


Doubles = NDArray[np.float64]

DARK_LEVEL = 16
"""Largest value 0..255 of a pixel that counts as outside the fan, where compressed videos ring."""

MIN_ROWS = 24
"""Minimum number of rows of an edge, and of columns of an arc."""

INLIER_PX = 1.5
"""Distance inside an edge or arc beyond which a pixel does not belong to it [px]."""

MIN_INLIERS = 0.5
"""Minimum fraction of the pixels of an edge or arc that must belong to it."""

MAX_ITERATIONS = 30

STRETCH_TOLERANCE, ANGLE_TOLERANCE_DEG, PX_TOLERANCE = 0.05, 0.75, 0.02
"""Tolerated differences between given and measured geometry: relative, in degrees, and as a fraction of ``far_px``."""


class Outline(NamedTuple):
    """Geometry of a fan, measured from its outline.

    Attributes:
        apex_px: column and row where the edges meet [px].
        far_px: distance of the far arc from the apex along the fan's axis [px].
        half_angle_deg: angle from the axis to an edge after the stretch [deg].
        stretch: factor on the columns that makes the far arc a circle.
    """

    apex_px: tuple[float, float]
    far_px: float
    half_angle_deg: float
    stretch: float


def outline_of(brightest: NDArray[np.generic], *, forward: str = "up") -> Outline | None:
    """Measure the outline of a fan: two straight edges and a circular far arc.

    The edges of a fan meet in its apex even if the picture is squeezed sideways. Only one stretch of the columns turns the
    far arc into a circle about that apex. The half angle follows from the edges after that stretch.

    Args:
        brightest: largest value 0..255 of each pixel over several pictures ``(rows, columns)``.
        forward: ``up`` or ``down``, the direction in which ranges increase.

    Returns:
        The outline; None if there are no straight edges or no arc, or if the picture cuts the fan off.
    """
    # 1. Separate the fan from its dark surroundings, and flip a fan that opens downwards.
    mask = np.asarray(brightest) > DARK_LEVEL
    mask = mask if forward == "up" else mask[::-1]
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    if len(rows) < MIN_ROWS or len(columns) < MIN_ROWS:
        return None
    # 2. Fit the edges to the first and last bright pixel of each row. Negated columns make the right edge a left one.
    first = mask[rows].argmax(axis=1).astype(float)
    last = mask.shape[1] - 1 - mask[rows][:, ::-1].argmax(axis=1).astype(float)
    left, right = _edge(rows.astype(float), first), _edge(rows.astype(float), -last)
    if left is None or right is None or left[1] + right[1] <= 0.02:
        return None
    # 3. Intersect the edges in the apex.
    approach = left[1] + right[1]  # the edges approach each other by this many columns per row
    row = (-right[0] - left[0]) / approach
    column = left[0] + left[1] * row
    # 4. Fit the far arc to the topmost bright pixel of each column, relative to the apex.
    top = mask[:, columns].argmax(axis=0).astype(float)
    arc = _arc(np.asarray(columns - column, dtype=float), np.asarray(row - top, dtype=float))
    if arc is None:
        return None
    # 5. Compute the half angle from the slopes of the edges after the stretch, and undo the flip.
    far, stretch = arc
    half = math.degrees(math.atan(stretch * approach / 2))
    row = row if forward == "up" else mask.shape[0] - 1 - row
    return Outline((float(column), float(row)), far, half, stretch)


def doubts(geometry: PictureGeometry, brightest: NDArray[np.generic]) -> list[str]:
    """Compare a geometry with the outline of its pictures, and return sentences on the disagreements."""
    outline = outline_of(brightest, forward=geometry.forward)
    if outline is None:
        return ["the pictures show no outline of a fan: stretch and half angle could not be checked"]
    apex_px = geometry.apex_px or (0.0, 0.0)
    notes = []
    half = float(geometry.half_angle_deg or 0.0)
    if abs(outline.stretch / geometry.stretch - 1) > STRETCH_TOLERANCE:
        notes.append(
            f"the far arc is a circle with stretch {outline.stretch:.3f}, and the edges then open "
            f"{outline.half_angle_deg:.2f} deg to each side; the geometry gives stretch {geometry.stretch:g} and {half:g} "
            "deg: the pictures are squeezed, or the geometry belongs to other pictures"
        )
    elif abs(outline.half_angle_deg - half) > ANGLE_TOLERANCE_DEG:
        notes.append(
            f"the edges of the fan open {outline.half_angle_deg:.2f} deg to each side, the geometry gives {half:g} deg"
        )
    distance_px = math.hypot((outline.apex_px[0] - apex_px[0]) * geometry.stretch, outline.apex_px[1] - apex_px[1])
    if distance_px > PX_TOLERANCE * geometry.far:
        notes.append(
            f"the edges of the fan meet at ({outline.apex_px[0]:.1f}, {outline.apex_px[1]:.1f}) px, the geometry gives "
            f"apex_px ({apex_px[0]:g}, {apex_px[1]:g})"
        )
    elif abs(outline.far_px - geometry.far) > PX_TOLERANCE * geometry.far:
        notes.append(
            f"the far arc lies at {outline.far_px:.1f} px from the apex, the geometry gives far_px {geometry.far:g}"
        )
    return notes


def _edge(row: Doubles, column: Doubles) -> tuple[float, float] | None:
    """Fit a straight edge column = a + b row to the low side of pixels ``(n,)``; return a and b, or None if there is none.

    Pixels inside the edge are dropped, as they border dark parts of the fan or its far arc.
    """
    # Alternate between fitting a line and selecting the pixels near it. The tolerance is wider outside the edge, so that
    # the line moves outwards. While too few pixels are near, the outer half of them is used.
    selected = np.ones(len(row), dtype=bool)
    for _ in range(MAX_ITERATIONS):
        slope, start = np.polyfit(row[selected], column[selected], 1)
        distance_px = column - (start + slope * row)
        updated = (distance_px < INLIER_PX) & (distance_px > -3 * INLIER_PX)
        updated = updated if updated.sum() >= MIN_ROWS else distance_px < np.median(distance_px)
        if (updated == selected).all():
            break
        selected = updated
    distance_px = column - (start + slope * row)
    close = np.abs(distance_px) < INLIER_PX
    return (float(start), float(slope)) if close.sum() >= max(MIN_ROWS, MIN_INLIERS * len(row)) else None


def _arc(x: Doubles, y: Doubles) -> tuple[float, float] | None:
    """Fit the far arc y^2 = far^2 - stretch^2 x^2 to pixels ``(n,)``; return far [px] and stretch, or None without an arc.

    Pixels below the arc are dropped, as they border dark parts of the fan or belong to its edges.
    """
    # Alternate between a least-squares fit, which is linear in far^2 and stretch^2, and selecting the pixels near the arc.
    # Start with the upper half of the pixels, most of which belong to the arc.
    selected = y > np.median(y) - 1e-9
    far, squared = 0.0, 0.0
    for _ in range(MAX_ITERATIONS):
        table = np.column_stack([np.ones(int(selected.sum())), -(x[selected] ** 2)])
        (far_squared, squared), *_ = np.linalg.lstsq(table, y[selected] ** 2, rcond=None)
        if far_squared <= 0 or squared <= 0:
            return None
        far = math.sqrt(far_squared)
        distance_px = np.sqrt(np.maximum(far_squared - squared * x**2, 0)) - y
        updated = (distance_px < INLIER_PX) & (distance_px > -3 * INLIER_PX)
        if updated.sum() < MIN_ROWS or (updated == selected).all():
            break
        selected = updated
    enough = selected.sum() >= max(MIN_ROWS, MIN_INLIERS * len(x))
    return (far, math.sqrt(squared)) if enough else None
