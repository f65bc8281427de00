"""The parts of a data set's recipe: scenes, mount, receivers, flight, split, and frames that were taken from elsewhere."""

from __future__ import annotations

import math
from typing import Annotated, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from mitsonar.config.recipe_keys import Keys
from mitsonar.errors import shortened
from mitsonar.motion.pose import Pose
from mitsonar.worlds.world import Interval

__all__ = [
    *("SPLITS", "Flight", "MirrorKeys", "Mount", "ReceiverSpec", "RecipePart", "Recorded", "RecordedSource", "Scenes"),
    "Split",
]


class RecipePart(BaseModel):
    """Keys of a recipe that are checked; unknown ones are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def _as_mirrors(given: object) -> object:
    if given is None or given == "materials":
        return given
    fits = isinstance(given, dict) and len(given) > 0
    for part in given.values() if isinstance(given, dict) else ():
        two = isinstance(part, list | tuple) and len(part) == 2
        fits &= two and all(isinstance(value, int | float) and not isinstance(value, bool) for value in part)
        fits = fits and -1 <= part[0] <= 1 and 0 <= part[1] <= 1
    if not fits:
        raise ValueError(
            "give [reflection, rms height in m] by the ids of shapes, reflections in -1..1 and rms heights in 0..1, or the "
            f"word materials: got {shortened(given)}"
        )
    return given


MirrorKeys: TypeAlias = Annotated[dict[str, tuple[float, float]] | Literal["materials"] | None, BeforeValidator(_as_mirrors)]
"""Reflection coefficient of pressures and rms height [m] by the ids of shapes, or ``materials``; None: no mirrors."""


class Scenes(RecipePart):
    """A group of scenes of one kind; each has its own seed."""

    count: int = Field(1, ge=1, le=100_000, description="how many scenes")
    sequences: int = Field(ge=1, le=10**7, description="sequences in each")
    world: Keys = Field(default_factory=dict, description="numbers of the world that differ in these scenes")


class Mount(RecipePart):
    """Pose of the sonar in the vehicle's axes (starboard, forward, up); the vehicle itself is level."""

    starboard_m: float = Field(0.0, allow_inf_nan=False)
    forward_m: float = Field(0.0, allow_inf_nan=False)
    up_m: float = Field(0.0, allow_inf_nan=False)
    pitch_deg: float = Field(0.0, ge=-90, le=90, description="> 0 looks down")
    roll_deg: float = Field(0.0, ge=-180, le=180, description="> 0 puts starboard down")
    heading_deg: float = Field(0.0, ge=-360, le=360, description="> 0 looks to starboard")

    @property
    def pose(self) -> Pose:
        """Return the pose in metres and radians."""
        return Pose(
            self.starboard_m,
            self.forward_m,
            self.up_m,
            *(math.radians(angle) for angle in (self.pitch_deg, self.roll_deg, self.heading_deg)),
        )


RESERVED = ("frames", "label")
"""Names that samples use beside those of their views."""


def _fits_name(name: str) -> str:
    if not name.isidentifier():
        raise ValueError(f"a name is letters, digits and _ : got {shortened(name)}")
    if name in RESERVED or name.startswith("nonzero"):
        raise ValueError(f"{name} means something else in a data set: choose another name")
    return name


class ReceiverSpec(Mount):
    """A receiver beside the transmitter: its pose in the transmitter's axes, and keys of its sonar that differ."""

    name: Annotated[str, AfterValidator(_fits_name)]
    sonar: Keys = Field(default_factory=dict, description="keys of the receiver's sonar that differ")


def _from_0(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] < 0:
        raise ValueError(f"a jump goes either way, give its size low,high with 0 <= low: got {pair[0]:g},{pair[1]:g}")
    return pair


def _box(corners: tuple[float, ...]) -> tuple[float, ...]:
    if not all(low < high for low, high in zip(corners[:3], corners[3:], strict=True)):
        raise ValueError(f"a box is x, y, z of its least corner, then of its largest: got {corners}")
    return corners


_NotBelow0 = Annotated[Interval, AfterValidator(_from_0)]
_Angle = Annotated[float, Field(gt=0, le=180)]
_Box = Annotated[tuple[float, float, float, float, float, float], AfterValidator(_box)]


class Flight(RecipePart):
    """Motion of the vehicle: sequences of pings at a constant rate with jumps between them, or named runs."""

    kind: Literal["random", "runs", "recorded"] = Field(
        "random", description="random sequences, the runs of chapters 2 and 4, or paths of recorded frames"
    )
    height_m: Interval | float = Field(2.5, description="over z = 0 [m]; low,high: drawn for each sequence")
    pings: int = Field(5, ge=1, le=10**6, description="pings of a sequence")
    sideways_mm: float = Field(20.0, ge=0, le=1e6, description="largest motion to either side between pings [mm]")
    forward_mm: float = Field(20.0, ge=0, le=1e6, description="largest motion ahead or back between pings [mm]")
    yaw_deg: float = Field(0.45, ge=0, le=180, description="largest turn between pings [deg]")
    jump_m: _NotBelow0 | None = Field((3.0, 4.0), description="jump between sequences, in x and in y [m]; null: anywhere")
    footprint_fov_deg: tuple[_Angle, _Angle] | None = Field(
        None, description="field of view whose footprint stays inside the scene [deg]; default: the sonar's"
    )
    pitch_deg: Interval | None = Field(
        None, description="pitch of the vehicle, low,high [deg], > 0 down, drawn for each sequence; null: level"
    )
    keep_out: list[_Box] = Field(
        default_factory=list, max_length=10_000, description="boxes without the vehicle: x, y, z of two corners [m]"
    )
    runs: list[Literal["legs", "diagonal", "turn", "sideways_50", "sideways_54"]] = Field(
        default=["legs", "diagonal", "turn"], min_length=1, description="runs of each scene"
    )

    @model_serializer(mode="wrap")
    def _without_absent(self, handler: SerializerFunctionWrapHandler) -> Keys:
        """Leave out what later versions added where it is not used: stores and checkpoints keep their digests."""
        return {key: value for key, value in handler(self).items() if key not in ("pitch_deg", "keep_out") or value}

    @model_validator(mode="after")
    def _pitched(self) -> Self:
        if self.pitch_deg is not None and not (self.pitch_deg[0] >= -90 and self.pitch_deg[1] <= 90):
            raise ValueError(f"pitch_deg must lie in -90..90: got {self.pitch_deg[0]:g},{self.pitch_deg[1]:g}")
        if (self.pitch_deg or self.keep_out) and self.kind != "random":
            raise ValueError(f"pitch_deg and keep_out are of random flights: got flight.kind {self.kind}")
        return self

    @property
    def heights(self) -> tuple[float, float]:
        """Return lowest and highest height [m]."""
        return (self.height_m, self.height_m) if isinstance(self.height_m, float | int) else self.height_m


SPLITS = ("sequence", "scene", "sample")
"""Names of splits, as :attr:`Split.by`."""


class Split(RecipePart):
    """Division of the frames into training, validation and test, unless a reader asks for another."""

    by: Literal["sequence", "scene", "sample"] = Field(
        "sequence", description="what is dealt out: sequences, whole scenes, or samples, which leaks (but test: sequences)"
    )
    train: float = Field(0.95, ge=0, le=1)
    validation: float = Field(0.05, ge=0, le=1)
    test: float = Field(0.0, ge=0, le=1)
    seed: int = Field(0, ge=0, lt=2**31, description="of the draw; readers of one data set must agree on it")

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if abs(self.train + self.validation + self.test - 1) > 1e-9:
            raise ValueError(
                f"train, validation and test must add up to 1: got {self.train + self.validation + self.test:g}"
            )
        return self

    @property
    def unseen(self) -> str:
        """Return the part for evaluation: test where there is one, else validation."""
        return "test" if self.test > 0 else "validation"


class RecordedSource(RecipePart):
    """A file, or a run, whose frames are one scene of a data set."""

    name: str = Field(min_length=1, description="of the file or folder, as it was given")
    format: str = Field(description="in words: ARIS 5 (.aris), run of mitsonar")
    poses: str = Field(description="where its poses come from: its own, or the name of a file of poses")
    frames: int = Field(ge=1, description="that were taken")
    left_out: int = Field(0, ge=0, description="frames without a pose, of another geometry, or with no neighbour")
    level_scale: float = Field(1.0, gt=0, allow_inf_nan=False, description="level of a pixel of 1")
    start_s: float = Field(allow_inf_nan=False, description="time of its first frame [s]; those that are stored begin at 0")


class Recorded(RecipePart):
    """Frames that were not rendered by the recipe: of runs and of recordings with known poses."""

    sources: list[RecordedSource] = Field(min_length=1, description="a scene each, in this order")
    level: Literal["linear", "dB", "gamma"] = Field("linear", description="how pixels stand for levels")
    bearings: list[float] | None = Field(
        None, min_length=1, max_length=65_536, description="axes of the beams [rad], where they are not those of the sonar"
    )

    @model_validator(mode="after")
    def _rising(self) -> Self:
        table = np.array(self.bearings or [0.0])
        if not (np.abs(table) <= math.pi).all() or (np.diff(table) <= 0).any():
            raise ValueError("bearings must rise within -pi..pi")
        return self

    @property
    def bearing_rad(self) -> NDArray[np.float64] | None:
        """Return the axes of the beams ``(beams,)`` [rad]; None where they are those of the sonar."""
        return None if self.bearings is None else np.array(self.bearings)
