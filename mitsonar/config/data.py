"""Which keys the recipe of a data set has, and how it is read from YAML and validated.

The recipes of Almanza-Medina's data sets are shipped.
"""

from __future__ import annotations

import json
import math
import os
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from mitsonar.acoustics.materials import check_channel_mirrors, check_image_mirrors
from mitsonar.errors import MitsonarError, short_repr, suggest_names, validation_message
from mitsonar.instruments.hydrophones import ChannelSonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.instruments.sounder import sonar_from
from mitsonar.instruments.views import Receiver, Segment, View, Whole
from mitsonar.io.files import read_yaml
from mitsonar.io.runs import digest
from mitsonar.motion.pose import Pose
from mitsonar.worlds.families import create_family
from mitsonar.worlds.world import BuiltFamily, Family, Interval

__all__ = [
    "SPLITS",
    "Flight",
    "Keys",
    "MirrorKeys",
    "Mount",
    "ReceiverSpec",
    "Recipe",
    "RecipePart",
    "Recorded",
    "RecordedSource",
    "Scenes",
    "Split",
    "array_names",
    "load_recipe",
    "recipe_fields",
    "set_key",
    "shipped_recipes",
    "split_from",
]


# ---------------- Reading and changing keys


Keys: TypeAlias = dict[str, Any]
"""Keys and values of a recipe or of a part of it, as read from YAML; a model validates them."""


def recipe_fields(
    name_or_file: str | Path, shipped: dict[str, Path], what: str, model: type[BaseModel], else_: str = ""
) -> tuple[Keys, Path]:
    """Read the keys of a recipe from a YAML file, or from the shipped recipe of that name.

    Args:
        name_or_file: name of a shipped recipe, such as ``rocky-field``, or a file, such as ``mine.yaml``.
        shipped: files of the shipped recipes, keyed by name.
        what: kind of recipe, for error messages.
        model: model of the recipe, whose fields are the known keys.
        else_: alternatives to a YAML file, for error messages.

    Returns:
        The keys, not validated, and the file.

    Raises:
        MitsonarError: there is no such recipe, or the file is not YAML or not a table.
    """
    path = Path(name_or_file)
    if path.suffix.lower() not in (".yaml", ".yml"):
        if str(name_or_file) not in shipped:
            names = suggest_names(str(name_or_file), shipped)
            raise MitsonarError(
                f"no {what} {str(name_or_file)!r}: give a YAML file or the name of a shipped recipe, {names}"
            )
        path = shipped[str(name_or_file)]
    fields = read_yaml(path, what, else_)
    if not (isinstance(fields, dict) and all(isinstance(key, str) for key in fields)):
        keys = ", ".join(field.alias or name for name, field in model.model_fields.items())
        raise MitsonarError(f"{path} must hold the keys of a {what}: {keys}")
    return fields, path


def set_key(fields: Keys, key: str, value: object) -> None:
    """Set a key of a recipe in place.

    Args:
        fields: keys of the recipe; modified in place.
        key: name of the key, with dots between the levels.
        value: value to set.

    Raises:
        MitsonarError: a level is not a group of keys.
    """
    *levels, last = key.split(".")
    for level in levels:
        fields = fields.setdefault(level, {})
        if not isinstance(fields, dict):
            raise MitsonarError(f"cannot set {key}: {level} is not a group of keys; change it in a YAML file")
    fields[last] = value


# ---------------- Parts of a recipe


class RecipePart(BaseModel):
    """A validated part of a recipe; unknown keys are errors."""

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
            f"word materials: got {short_repr(given)}"
        )
    return given


MirrorKeys: TypeAlias = Annotated[dict[str, tuple[float, float]] | Literal["materials"] | None, BeforeValidator(_as_mirrors)]
"""Pressure reflection coefficient and rms height [m], keyed by shape id; or ``materials``; None: no mirrors."""


class Scenes(RecipePart):
    """A group of similar scenes, each with a different seed."""

    count: int = Field(1, ge=1, le=100_000, description="number of scenes")
    sequences: int = Field(ge=1, le=10**7, description="sequences per scene")
    world: Keys = Field(default_factory=dict, description="parameters of the world that differ in these scenes")


class Mount(RecipePart):
    """Pose of the sonar in the vehicle's axes (starboard, forward, up); the vehicle is level."""

    starboard_m: float = Field(0.0, allow_inf_nan=False)
    forward_m: float = Field(0.0, allow_inf_nan=False)
    up_m: float = Field(0.0, allow_inf_nan=False)
    pitch_deg: float = Field(0.0, ge=-90, le=90, description="> 0 looks down")
    roll_deg: float = Field(0.0, ge=-180, le=180, description="> 0 puts starboard down")
    heading_deg: float = Field(0.0, ge=-360, le=360, description="> 0 looks to starboard")

    @property
    def pose(self) -> Pose:
        """Return the mount as a pose in metres and radians."""
        return Pose(
            self.starboard_m,
            self.forward_m,
            self.up_m,
            *(math.radians(angle) for angle in (self.pitch_deg, self.roll_deg, self.heading_deg)),
        )


RESERVED = ("frames", "label")
"""Names that samples use for other purposes, so that no view may have them."""


def _check_view_name(name: str) -> str:
    if not name.isidentifier():
        raise ValueError(f"a name must consist of letters, digits and _: got {short_repr(name)}")
    if name in RESERVED or name.startswith("nonzero"):
        raise ValueError(f"{name} is reserved in a data set: choose another name")
    return name


class ReceiverSpec(Mount):
    """A receiver of a bistatic sonar: its pose in the transmitter's axes, and the keys of its sonar that differ."""

    name: Annotated[str, AfterValidator(_check_view_name)]
    sonar: Keys = Field(default_factory=dict, description="keys of the receiver's sonar that differ")


def _check_jump(pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] < 0:
        raise ValueError(f"a jump must be its size low,high with 0 <= low, in either direction: got {pair[0]:g},{pair[1]:g}")
    return pair


def _check_box(corners: tuple[float, ...]) -> tuple[float, ...]:
    if not all(low < high for low, high in zip(corners[:3], corners[3:], strict=True)):
        raise ValueError(f"a box must be x, y, z of its lowest corner, then of its highest: got {corners}")
    return corners


_Jump = Annotated[Interval, AfterValidator(_check_jump)]
_Angle = Annotated[float, Field(gt=0, le=180)]
_Box = Annotated[tuple[float, float, float, float, float, float], AfterValidator(_check_box)]


class Flight(RecipePart):
    """Motion of the vehicle: sequences of pings at a constant rate, with jumps between the sequences, or named runs."""

    kind: Literal["random", "runs", "recorded"] = Field(
        "random", description="random sequences, the runs of chapters 2 and 4, or paths of recorded frames"
    )
    height_m: Interval | float = Field(2.5, description="height over z = 0 [m]; low,high: drawn for each sequence")
    pings: int = Field(5, ge=1, le=10**6, description="pings per sequence")
    sideways_mm: float = Field(20.0, ge=0, le=1e6, description="largest motion to either side between pings [mm]")
    forward_mm: float = Field(20.0, ge=0, le=1e6, description="largest motion ahead or back between pings [mm]")
    yaw_deg: float = Field(0.45, ge=0, le=180, description="largest turn between pings [deg]")
    jump_m: _Jump | None = Field((3.0, 4.0), description="jump between sequences, in x and in y [m]; null: anywhere")
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
        """Omit unused keys that later versions added, so that the digests of stores and checkpoints do not change."""
        return {key: value for key, value in handler(self).items() if key not in ("pitch_deg", "keep_out") or value}

    @model_validator(mode="after")
    def _check_random_only(self) -> Self:
        if self.pitch_deg is not None and not (self.pitch_deg[0] >= -90 and self.pitch_deg[1] <= 90):
            raise ValueError(f"pitch_deg must lie in -90..90: got {self.pitch_deg[0]:g},{self.pitch_deg[1]:g}")
        if (self.pitch_deg or self.keep_out) and self.kind != "random":
            raise ValueError(f"pitch_deg and keep_out apply to random flights only: got flight.kind {self.kind}")
        return self

    @property
    def heights(self) -> tuple[float, float]:
        """Return the lowest and the highest height [m]."""
        return (self.height_m, self.height_m) if isinstance(self.height_m, float | int) else self.height_m


SPLITS = ("sequence", "scene", "sample")
"""Allowed values of :attr:`Split.by`."""


class Split(RecipePart):
    """Default division of the frames into training, validation and test; a reader may choose another."""

    by: Literal["sequence", "scene", "sample"] = Field(
        "sequence", description="what is divided: sequences, scenes, or samples, which leaks (except into the test part)"
    )
    train: float = Field(0.95, ge=0, le=1)
    validation: float = Field(0.05, ge=0, le=1)
    test: float = Field(0.0, ge=0, le=1)
    seed: int = Field(0, ge=0, lt=2**31, description="seed of the division; readers of one data set must use the same")

    @model_validator(mode="after")
    def _check_shares(self) -> Self:
        if abs(self.train + self.validation + self.test - 1) > 1e-9:
            raise ValueError(
                f"train, validation and test must add up to 1: got {self.train + self.validation + self.test:g}"
            )
        return self

    @property
    def unseen(self) -> str:
        """Return the name of the part for evaluation: ``test`` if there is one, otherwise ``validation``."""
        return "test" if self.test > 0 else "validation"


class RecordedSource(RecipePart):
    """A recording or a run whose frames form one scene of a data set."""

    name: str = Field(min_length=1, description="name of the file or folder, as given")
    format: str = Field(description="format in words: ARIS 5 (.aris), run of mitsonar")
    poses: str = Field(description="source of its poses: the recording, or the name of a file of poses")
    frames: int = Field(ge=1, description="number of frames taken from it")
    left_out: int = Field(0, ge=0, description="frames without a pose, of another geometry, or with no neighbour")
    level_scale: float = Field(1.0, gt=0, allow_inf_nan=False, description="level of a pixel of 1")
    start_s: float = Field(allow_inf_nan=False, description="time of its first frame [s]; stored times begin at 0")
    world: str = Field("", max_length=64, description="digest of its rendered world, if known; one world stays in one part")


class Recorded(RecipePart):
    """Frames that the recipe does not render: from runs, and from recordings with known poses."""

    sources: list[RecordedSource] = Field(min_length=1, description="sources, one scene each, in this order")
    level: Literal["linear", "dB", "gamma"] = Field("linear", description="coding of levels in pixels")
    bearings: list[float] | None = Field(
        None,
        min_length=1,
        max_length=65_536,
        description="bearings of the beams [rad], if they differ from those of the sonar",
    )

    @model_validator(mode="after")
    def _check_bearings(self) -> Self:
        table = np.array(self.bearings or [0.0])
        if not (np.abs(table) <= math.pi).all() or (np.diff(table) <= 0).any():
            raise ValueError("bearings must increase within -pi..pi")
        return self

    @property
    def bearing_rad(self) -> NDArray[np.float64] | None:
        """Return the bearings of the beams ``(beams,)`` [rad], or None if they are those of the sonar."""
        return None if self.bearings is None else np.array(self.bearings)


# ---------------- The recipe of a data set


_PartT = TypeVar("_PartT", bound=RecipePart)

OPTIONAL_KEYS = ("recorded", "mirrors", "bodies", "noise_db", "visible_labels")
"""Keys that are omitted from a written recipe if they are null or empty."""


class Recipe(RecipePart):
    """The recipe of a data set.

    Angles are in degrees and motions in millimetres; all other values have SI units. The keys are documented in
    docs/reference/files.md.

    Raises:
        MitsonarError: through :func:`load_recipe`, a key is unknown or a value is outside its limits.
    """

    name: str = Field("custom", description="name of the data set")
    about: str = Field("", description="description in one sentence")
    seed: int = Field(0, ge=0, lt=2**31, description="seed of worlds, flights and jitter")
    world: Keys = Field(
        default_factory=dict, description="family of the world, and its parameters; empty for recorded frames"
    )
    scenes: list[Scenes] = Field(min_length=1, description="the scenes, each with its sequences")
    sonar: Keys | None = Field(None, description="preset and keys of docs/reference/plugins.md")
    channel: Keys | None = Field(None, description="for responses: keys of docs/reference/plugins.md")
    mount: Mount = Field(
        default_factory=lambda: Mount(pitch_deg=35.0), description="pose of the sonar on the vehicle; not with channel"
    )
    flight: Flight = Field(default_factory=Flight, description="motion of the vehicle")
    frames: int = Field(2, ge=1, le=16, description="Q: default number of frames per sample")
    receivers: list[ReceiverSpec] = Field(
        default_factory=list, description="receivers of a bistatic sonar; the sonar transmits"
    )
    segments: list[str] = Field(default_factory=list, description="segments of a downward-looking sonar's field of view")
    store: Literal["images", "vectors", "both"] = Field("images", description="images, vectors (sums over beams), or both")
    pixel: Literal["uint8", "float32"] = Field("uint8", description="type of stored pixels")
    gain: float | None = Field(
        None,
        gt=0,
        allow_inf_nan=False,
        description="gain of the pixels, such as that of another data set; null: set on the first frames",
    )
    labels: list[Literal["elevation_rad", "shape_id", "object_id", "shadow"]] = Field(
        default_factory=list, description="per-pixel truth to store"
    )
    split: Split = Field(default_factory=Split, description="division into training, validation and test")
    recorded: Recorded | None = Field(None, description="sources of frames that were recorded, not rendered")
    mirrors: MirrorKeys = Field(
        None, description="shapes that reflect as mirrors: [reflection, rms height in m] by their ids, or materials"
    )
    bodies: list[str] = Field(
        default_factory=list, max_length=10_000, description="moving bodies whose poses and velocities are stored"
    )
    visible_labels: bool = Field(
        False,
        description="labels of all that pictures show, also beyond half-power beams, above noise and -40 dB (coherent)",
    )
    noise_db: list[Annotated[float, Field(ge=-100, le=100)]] = Field(
        default_factory=list,
        max_length=1000,
        description="values that scenes add to the sonar's noise_level_db, in turn [dB] (coherent)",
    )

    @model_serializer(mode="wrap")
    def _without_absent(self, handler: SerializerFunctionWrapHandler) -> Keys:
        """Omit unused keys that later versions added, so that the digests of stores and checkpoints do not change."""
        return {key: value for key, value in handler(self).items() if key not in OPTIONAL_KEYS or value}

    @model_validator(mode="before")
    @classmethod
    def _level_channel_mount(cls, fields: object) -> object:
        """Make the default mount of a channel sonar level, with the vehicle's own attitude."""
        if isinstance(fields, dict) and fields.get("channel") is not None:
            return {"mount": Mount(), **fields}
        return fields

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.sonar is None) == (self.channel is None):
            got = "neither" if self.sonar is None else "both"
            raise ValueError(f"give either sonar (images) or channel (impulse responses): got {got}")
        try:
            self._check_images() if self.channel is None else self._check_responses()
            self._check_recorded()
            families = [self.family(group) for group in range(len(self.scenes))] if self.recorded is None else []
        except MitsonarError as error:
            raise ValueError(str(error)) from None
        low, high = self.flight.heights
        if not (low > 0 and math.isfinite(high)):
            raise ValueError(f"flight height_m must be finite and above 0: got {low:g} m")
        if low != high and self.flight.kind == "runs":
            raise ValueError(f"with flight.kind runs height_m must be one number: got {low:g},{high:g}")
        if self.frames > self.flight.pings and self.flight.kind == "random":
            raise ValueError(f"frames must be at most flight.pings, {self.flight.pings}: got {self.frames}")
        if self.flight.kind == "runs" and any(group.sequences != len(self.flight.runs) for group in self.scenes):
            raise ValueError(f"with flight.kind runs each scene must have {len(self.flight.runs)} sequences, one per run")
        if not all(family.half_m > 0 for family in families):
            raise ValueError("a scene must have a size")
        surfaces = [one.surface_m for one in families if isinstance(one, BuiltFamily) and one.surface_m is not None]
        if surfaces and high >= min(surfaces):
            raise ValueError(f"flight height_m must stay below the world's surface_m, {min(surfaces):g} m: got {high:g} m")
        return self

    def _check_recorded(self) -> None:
        """Check the keys for recorded frames.

        Raises:
            MitsonarError: keys contradict each other.
        """
        if (self.recorded is None) != (self.flight.kind != "recorded"):
            raise MitsonarError(
                "recorded and flight.kind recorded belong together: `mitsonar dataset from-frames` writes them"
            )
        if self.recorded is None:
            return
        has_other_keys = (
            self.world or self.channel is not None or self.receivers or self.segments or self.mirrors or self.bodies
        )
        if has_other_keys or self.store != "images":
            raise MitsonarError(
                "recorded frames are images of one sonar: leave out world, channel, receivers, segments, mirrors, bodies "
                "and store"
            )
        if len(self.scenes) != len(self.recorded.sources) or any(group.count != 1 for group in self.scenes):
            raise MitsonarError("each source of recorded frames is one scene")
        if self.recorded.bearings is not None and len(self.recorded.bearings) != self.instrument.beams:
            raise MitsonarError(f"recorded.bearings has {len(self.recorded.bearings):,} of {self.instrument.beams:,} beams")

    def _check_images(self) -> None:
        """Check the keys for images.

        Raises:
            MitsonarError: keys contradict each other.
        """
        if len({view.name for view in self.views}) < len(self.views):
            names = short_repr([view.name for view in self.views])
            raise MitsonarError(f"receivers and segments must have different names: got {names}")
        if len({(view.sonar.range_min, view.sonar.range_max, view.sonar.range_bins) for view in self.views}) > 1:
            raise MitsonarError("all receivers must have the same window: range_min, range_max and range_bins")
        if self.labels and self.store == "vectors":
            raise MitsonarError("labels are pixels: store images or both with them")
        if self.recorded is None and any(view.sonar.ping_groups > 1 for view in self.views):
            raise MitsonarError("a ping of a data set has one pose: leave out ping_groups, or set it to 1")
        if self.noise_db and (self.instrument.model != "coherent" or self.instrument.noise_level_db is None):
            raise MitsonarError(
                f"noise_db changes noise_level_db of the model coherent: the sonar is of the model {self.instrument.model} "
                f"with noise_level_db {self.instrument.noise_level_db}; give it both, or leave noise_db out"
            )
        if self.visible_labels and self.instrument.model != "coherent":
            raise MitsonarError(
                f"visible_labels applies to the model coherent only: got {self.instrument.model}, whose pictures show "
                "everything that is labelled"
            )
        if len(set(self.bodies)) < len(self.bodies):
            raise MitsonarError(f"each body must be named only once: got {short_repr(self.bodies)}")
        if self.recorded is None:
            check_image_mirrors(self.instrument, self.views, bool(self.mirrors))

    def _check_responses(self) -> None:
        """Check the keys for impulse responses.

        Raises:
            MitsonarError: a key of the instrument is not valid, or a key applies to images only.
        """
        check_channel_mirrors(self.channel_sonar, bool(self.mirrors), "give the recipe the key mirrors")
        defaults = {
            "mount": Mount(),
            "receivers": [],
            "segments": [],
            "labels": [],
            "store": "images",
            "pixel": "uint8",
            "gain": None,
            "bodies": [],
            "noise_db": [],
            "visible_labels": False,
        }
        misplaced = [name for name, value in defaults.items() if getattr(self, name) != value]
        image_defaults = {"footprint_fov_deg": None, "pitch_deg": None}
        misplaced += [f"flight.{name}" for name, value in image_defaults.items() if getattr(self.flight, name) != value]
        if misplaced:
            raise MitsonarError(
                f"{misplaced[0]} belongs to images: leave it out of a recipe with channel, whose receivers have their own "
                "positions and fields of view"
            )

    @cached_property
    def instrument(self) -> Sonar:
        """Return the sonar; for a bistatic data set, the transmitter.

        Raises:
            MitsonarError: the data set contains impulse responses.
        """
        if self.sonar is None:
            raise MitsonarError(
                f"the data set {self.name} holds impulse responses, but images are needed: `mitsonar compare` and "
                "ImpulsePairs read it"
            )
        return sonar_from(dict(self.sonar)).replace(seed=self.seed)

    @cached_property
    def channel_sonar(self) -> ChannelSonar:
        """Return the transmitter and receivers of a data set of impulse responses.

        Raises:
            MitsonarError: the data set contains images.
        """
        if self.channel is None:
            raise MitsonarError(f"the data set {self.name} holds images, but responses are needed: read it with SonarPairs")
        return ChannelSonar.create(**{"name": self.name, "seed": self.seed, **self.channel})

    @cached_property
    def views(self) -> list[View]:
        """Return the views, one for each image of a ping.

        Raises:
            MitsonarError: the recipe has both receivers and segments.
        """
        sonar = self.instrument
        if self.receivers and self.segments:
            raise MitsonarError("receivers and segments exclude each other: give one")
        if self.segments:
            return [Segment(sonar, name) for name in self.segments]
        receivers: list[View] = []
        for spec in self.receivers:
            keys = {**(self.sonar or {}), "beams": sonar.beams, "jitter": None, **spec.sonar}
            receivers.append(
                Receiver(sonar, sonar_from({k: v for k, v in keys.items() if v is not None}), spec.pose, spec.name)
            )
        return receivers or [Whole(sonar, None if self.recorded is None else self.recorded.bearing_rad)]

    def digest(self, *more: object) -> str:
        """Return a digest of all values that are not defaults, and of the values ``more``: 16 hexadecimal digits.

        New keys of later versions do not change the digest of recipes that do not use them.
        """
        values = self.model_dump(mode="json", exclude_defaults=True)
        return digest(json.dumps([values, *more]))[:16]

    def suffix(self, view: str) -> str:
        """Return the suffix of the names of a view's arrays; empty if there is only one view."""
        return f"_{view}" if len(self.views) > 1 else ""

    @property
    def kinds(self) -> tuple[str, ...]:
        """Return the kinds of arrays stored for each view: ``image``, ``vector``, or both."""
        return {"images": ("image",), "vectors": ("vector",), "both": ("image", "vector")}[self.store]

    def family(self, group: int) -> Family:
        """Return the family of worlds of a group of scenes.

        Raises:
            MitsonarError: the family is missing or unknown, a number is outside its limits, or the frames are recorded.
        """
        if self.recorded is not None:
            raise MitsonarError(
                f"the data set {self.name} holds recorded frames and no worlds, so nothing can be rendered: give the output "
                "of `mitsonar dataset make`"
            )
        fields = {**self.world, **self.scenes[group].world}
        if "family" not in fields:
            raise MitsonarError(
                "world lacks family: give rocky-field, ship-hull, pattern, flat-objects, sea-surface or scene"
            )
        return create_family(str(fields.pop("family")), **fields)

    def noise_raised_db(self, scene: ArrayLike) -> NDArray[np.float64]:
        """Return the levels that scenes add to the noise of the sonar ``(...)`` [dB], given the scenes' numbers."""
        numbers = np.asarray(scene)
        return np.asarray(np.array(self.noise_db or [0.0])[numbers % max(1, len(self.noise_db))], dtype=np.float64)

    def level_of(self, view: View) -> str:
        """Return the coding of levels in the pixels of a view: that of the recorded frames, or of the view's sonar."""
        return view.sonar.value_coding if self.recorded is None else self.recorded.level

    @property
    def sequences(self) -> int:
        """Return the number of sequences of the whole data set."""
        return sum(group.count * group.sequences for group in self.scenes)


def array_names(recipe: Recipe) -> dict[str, tuple[str, str]]:
    """Return the stored arrays as name -> (kind, view); names end with the view's name if there are several views."""
    names = {}
    for view in recipe.views:
        kinds = [*recipe.kinds, *(["nonzero"] if "vector" in recipe.kinds else []), *recipe.labels]
        for kind in kinds:
            names[f"{kind}{recipe.suffix(view.name)}"] = (kind, view.name)
    return names


def shipped_recipes() -> dict[str, Path]:
    """Return the files of the shipped recipes, keyed by name."""
    folder = Path(str(files("mitsonar.config"))) / "recipes"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def load_recipe(name_or_file: str | Path, changes: Keys | None = None) -> Recipe:
    """Load the recipe of a data set from a YAML file, or the shipped recipe of that name.

    Args:
        name_or_file: name of a shipped recipe, such as ``rocky-field``, or a file, such as ``mine.yaml``.
        changes: keys to change, with dots between the levels: ``{"sonar.range_bins": 256}``.

    Raises:
        MitsonarError: there is no such recipe, the file is not YAML, a key is unknown, or a value is outside its limits.
    """
    fields, path = recipe_fields(
        name_or_file, shipped_recipes(), "recipe", Recipe, " or a name of `mitsonar dataset recipes`"
    )
    for key, value in (changes or {}).items():
        set_key(fields, key, value)
    _resolve_files(fields, path.parent)
    return recipe_from({"name": path.stem, **fields})


def recipe_from(fields: Keys) -> Recipe:
    """Create a recipe from its keys, after validation.

    Raises:
        MitsonarError: a key is unknown, or a value is outside its limits.
    """
    return _validated(Recipe, "recipe", fields)


def split_from(fields: Keys) -> Split:
    """Create a split from its keys, after validation.

    Raises:
        MitsonarError: a key is unknown, or a value is outside its limits.
    """
    return _validated(Split, "split", fields)


def _validated(part: type[_PartT], what: str, fields: Keys) -> _PartT:
    try:
        return part(**fields)
    except ValidationError as error:
        raise MitsonarError(validation_message(error, part, what, " (see docs/reference/files.md)")) from None
    except TypeError as error:
        raise MitsonarError(f"{what} keys must be strings: {error}") from None


def _resolve_files(fields: Keys, folder: Path) -> None:
    """Resolve the scene files in ``fields`` relative to the folder of the recipe, in place."""
    groups = fields.get("scenes")
    for world in [
        fields.get("world"),
        *(g.get("world") for g in (groups if isinstance(groups, list) else []) if isinstance(g, dict)),
    ]:
        if isinstance(world, dict) and isinstance(world.get("file"), str):
            world["file"] = os.path.realpath(folder / world["file"])
