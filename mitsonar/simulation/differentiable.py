"""Expected sonar images with derivatives by pose, scene and instrument."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError, short_repr, suggest_names
from mitsonar.instruments.sonar import Sonar
from mitsonar.simulation.device import DeviceArray

if TYPE_CHECKING:
    import torch

__all__ = ["DifferentiableSimulator"]

EDGE_POINTS = 200_000
"""Default number of points on edges."""

SIX = "a pose is six numbers x, y, z [m], pitch, roll, heading [rad]"

INSTRUMENT = ("absorption_db_per_m", "beam_width_deg", "elevation_fov_deg", "sound_speed", "taper_db")
"""Properties of the sonar by which images can be differentiated."""

LEAST = {"absorption_db_per_m": 0, "beam_width_deg": 0.01, "elevation_fov_deg": 0.1, "sound_speed": 1, "taper_db": -60}
"""Smallest values of these."""

OF_BEAMS, OF_ELEVATION = ("absorption_db_per_m", "beam_width_deg"), ("elevation_fov_deg",)
"""Those that only sonars with a pattern of the beams have, and with a pattern over elevation."""


class DifferentiableSimulator:
    """Renderer of expected images that carry derivatives, for optimisation and for bounds.

    The levels are those of ``Simulator`` in the model ``physical``, before the gain of a run. Derivatives by pose, vertices,
    transforms and reflectances include what edges cover and uncover (:mod:`mitsonar.simulation.edges`).

    Args:
        scene: a scene at rest; change its parameters by ``mi.traverse(scene)``.
        sonar: a sonar of the model ``physical`` with one reflection and one ping a frame. Default: that of the scene.
        edge_points: number of points on edges; more give more exact derivatives. 0 leaves edges out.

    Attributes:
        scene: the scene.
        sonar: the sonar.
        pose: pose of the sonar in the scene, the default of :meth:`levels`; None if the scene has none.

    Raises:
        MitsonarError: there is no sonar; another model, several reflections or ping groups; absorption without a pattern; a
            shape without outlines.
    """

    def __init__(self, scene: mi.Scene, sonar: Sonar | None = None, *, edge_points: int = EDGE_POINTS) -> None:
        from mitsonar.simulation.attached_levels import AttachedLevels
        from mitsonar.simulation.edges import edges_of
        from mitsonar.simulation.scene import sonar_in

        placed = sonar_in(scene)
        if sonar is None and placed is None:
            raise MitsonarError("the scene has no imaging_sonar: give a sonar, such as mitsonar.load_sonar('didson300')")
        self.sonar = sonar or placed[0]  # type: ignore[index]  # one of the two is given
        self.pose = None if placed is None else placed[1]
        if self.sonar.model != "physical" or self.sonar.bounces != 1 or self.sonar.ping_groups != 1:
            raise MitsonarError(
                "images with derivatives are those of the model physical, with bounces 1 and ping_groups 1: got model "
                f"{self.sonar.model}, bounces {self.sonar.bounces}, ping_groups {self.sonar.ping_groups}; give "
                "sonar.replace(model='physical', bounces=1, ping_groups=1)"
            )
        if self.sonar.beam_pattern == "box" and self.sonar.absorption_db_per_m:
            raise MitsonarError(
                "the model physical applies absorption only with a beam pattern: give pattern two_way as well"
            )
        self.scene, self.edge_points = scene, edge_points
        self._attached = AttachedLevels(scene, self.sonar, edges_of(scene) if edge_points else [], edge_points)

    def __repr__(self) -> str:
        return f"DifferentiableSimulator({self.sonar!r}, {self.edge_points:,} points on edges)"

    def levels(self, pose: Sequence[Any] | None = None, *, ping: int = 0, **instrument: Any) -> mi.TensorXf:
        """Compute the expected levels of one ping.

        Args:
            pose: x, y, z [m], pitch, roll, heading [rad], numbers or ``mi.Float``; default: the pose in the scene.
            ping: number of the ping, which draws the places of jittered rays in their cells.
            instrument: numbers or ``mi.Float``. In place of those of the sonar, if it has a beam pattern:
                ``beam_width_deg``, ``absorption_db_per_m``, and with one over elevation ``elevation_fov_deg``. Besides:
                ``taper_db``, which the model ``physical`` leaves out, and the true ``sound_speed`` [m/s]; bins and gain are
                those of the sonar's own.

        Returns:
            Levels ``(bins, beams)``.

        Raises:
            MitsonarError: a pose that is not six numbers, or a property that is unknown or that the sonar does not have.
        """
        return self._attached.levels(self._pose(pose), ping, self._checked(instrument))

    def as_torch(self, *names: str) -> Callable[..., torch.Tensor]:
        """Return :meth:`levels` as a function of Torch tensors, with derivatives for ``backward``, which renders once more.

        Args:
            names: what the tensors are, in their order: ``pose`` (six numbers), properties of :meth:`levels`, or
                parameters of the scene as ``mi.traverse`` names them.

        Raises:
            MitsonarError: an unknown name.
        """
        import torch

        params = mi.traverse(self.scene)
        known = ["pose", *INSTRUMENT, *(name for name, _ in params)]
        for name in names:
            if name not in known:
                raise MitsonarError(f"unknown parameter {short_repr(name)}: {suggest_names(name, known)}")

        def rendered(values: Sequence[torch.Tensor], weight: torch.Tensor | None) -> list[NDArray[np.float32]]:
            """Return the levels, or with weights of the levels the derivatives of their sum by the values."""
            inputs: dict[str, DeviceArray] = {}
            for name, value in zip(names, values, strict=True):
                if name == "pose" and value.numel() != 6:
                    raise MitsonarError(f"{SIX}: got a tensor of {value.numel()}")
                array = np.ascontiguousarray(value.detach().cpu().numpy(), dtype=np.float32)
                kind = type(params[name]) if name in params else mi.Float
                flat = mi.Float(array.ravel())
                inputs[name] = (
                    flat if kind is mi.Float else mi.TensorXf(array) if dr.is_tensor_v(kind) else dr.unravel(kind, flat)
                )
            if weight is not None:
                dr.enable_grad(inputs)
            scene = {name: inputs[name] for name in names if name in params}
            params.update(scene)
            pose = [dr.gather(mi.Float, inputs["pose"], axis) for axis in range(6)] if "pose" in inputs else None
            levels = self.levels(pose, **{name: inputs[name] for name in names if name in INSTRUMENT})
            if weight is None:
                return [np.array(levels)]
            dr.backward(dr.sum(levels * mi.TensorXf(np.ascontiguousarray(weight.cpu().numpy(), dtype=np.float32))))
            params.update({name: dr.detach(value) for name, value in scene.items()})
            return [
                np.array(dr.ravel(dr.grad(value)) if not dr.is_tensor_v(value) else dr.grad(value))
                for value in inputs.values()
            ]

        class Levels(torch.autograd.Function):
            @staticmethod
            def forward(ctx: Any, *values: torch.Tensor) -> torch.Tensor:
                ctx.save_for_backward(*values)
                return torch.from_numpy(rendered(values, None)[0]).to(values[0].device)

            @staticmethod
            def backward(ctx: Any, weight: torch.Tensor) -> tuple[torch.Tensor, ...]:
                values = ctx.saved_tensors
                slopes = rendered(values, weight)
                pairs = zip(slopes, values, strict=True)
                return tuple(torch.from_numpy(slope).reshape(value.shape).to(value) for slope, value in pairs)

        return Levels.apply

    # ---------------- Checks

    def _pose(self, pose: Sequence[Any] | None) -> list[mi.Float]:
        pose = self.pose if pose is None else pose
        if pose is None or len(pose) != 6:
            got = "none" if pose is None else str(len(pose))
            raise MitsonarError(f"{SIX}: got {got}")
        numbers = [mi.Float(value) for value in pose]
        dr.make_opaque(numbers)  # inputs of the kernels, which another pose then compiles no more
        return numbers

    def _checked(self, instrument: dict[str, Any]) -> dict[str, mi.Float]:
        given = {name: mi.Float(value) for name, value in instrument.items()}
        for name, value in given.items():
            if name not in INSTRUMENT:
                raise MitsonarError(f"unknown property {short_repr(name)}: {suggest_names(name, INSTRUMENT)}")
            for names, field, pattern in (
                (OF_BEAMS, "pattern", self.sonar.beam_pattern),
                (OF_ELEVATION, "elevation_pattern", self.sonar.vertical_pattern),
            ):
                if name in names and pattern == "box":
                    raise MitsonarError(f"{name} needs a beam pattern: give the sonar {field} two_way")
            least = LEAST[name]
            if dr.width(value) != 1 or not (number := float(dr.detach(value)[0])) >= least or not math.isfinite(number):
                raise MitsonarError(f"{name} must be one number of at least {least:g}: got {value}")
        dr.make_opaque(given)
        return given
