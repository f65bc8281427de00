"""How a sonar is calibrated with frames of level ground: taper, pattern, absorption, noise, crosstalk, tilt and height."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mitsonar.errors import MitsonarError
from mitsonar.estimation.ground_levels import (
    FIELDS,
    INSTRUMENT,
    NO_CROSSTALK_DB,
    POSITIVE,
    GroundProblem,
    GroundSolution,
    reference_of,
)
from mitsonar.estimation.sonar_fit import SonarFit, fit_sonar
from mitsonar.instruments.sonar import Sonar
from mitsonar.records.frames import SonarFrames

__all__ = ["Calibrated", "Calibration", "calibrate_sonar"]

Array = NDArray[np.float64]

DETERMINED = 0.5
"""Ratio of the standard deviations after and before, above which the frames do not determine a parameter."""

CERTAIN_LEAK_DB = 2.0
"""Standard deviation [dB] above which crosstalk may as well be none, since a power is then not twice its own error."""

TOGETHER = {
    "level_db": ": gain and reflectivity together",
    "range_exponent": ": errors of gain_exponent and of Lambert's law together",
}
"""What has the same effect on level ground, by parameter."""


@dataclass(frozen=True)
class Calibrated:
    """One parameter of a calibration.

    Attributes:
        value: its estimate.
        std: its standard deviation, 0 for a given value.
        unit: of both.
        determined: False if the prior rather than the frames determines it.
    """

    value: float
    std: float
    unit: str
    determined: bool


@dataclass(frozen=True)
class Calibration:
    """A sonar calibrated with frames of level ground.

    Attributes:
        fit: the sonar with the fields that the frames determine, and what :func:`.fit_sonar` measures besides.
        parameters: by name, as in :data:`.FIELDS`.
        covariance: of the parameters ``(10, 10)``, in their units; rows of given values are 0.
        looks: effective number of independent looks of a block's mean.
        beam_gain_db: gain of each beam over the taper ``(beams,)`` [dB]; None unless requested.
        held_out: log likelihood per block, and rms error [dB], of this model and of ``sonar fit``, on frames that were
            not fitted; None for a single frame.
        outliers: fraction of blocks that was left out.
        notes: sentences on what could not be determined.
    """

    fit: SonarFit
    parameters: dict[str, Calibrated]
    covariance: Array
    looks: float
    beam_gain_db: Array | None
    held_out: dict[str, tuple[float, float]] | None
    outliers: float
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """Return the results as lines of text, one per quantity, with units."""
        lines = []
        for name, one in self.parameters.items():
            spread = "given" if one.std == 0 else f"+- {one.std:.2g}" + ("" if one.determined else " (not determined)")
            unit = f"{one.unit} " if one.unit else ""
            lines.append(f"{name:<23} {one.value:.4g} {unit}{spread}{TOGETHER.get(name, '')}")
        if self.beam_gain_db is not None:
            lines.append(f"gains of the beams      {self.beam_gain_db.std():.2f} dB rms about the taper")
        lines.append(f"looks of a block        {self.looks:.3g}; {100 * self.outliers:.1f} % of the blocks left out")
        for name, (likelihood, error) in (self.held_out or {}).items():
            lines.append(f"{'held out, ' + name:<23} log likelihood {likelihood:.3f} a block, {error:.2f} dB rms")
        return lines

    def yaml(self) -> str:
        """Return the sonar's file, with the results as comments."""
        return "".join(f"# {line}\n" for line in (*self.lines(), *self.notes)) + self.fit.yaml()


def calibrate_sonar(
    frames: SonarFrames,
    base: Sonar | None = None,
    *,
    height_m: float | None = None,
    pitch_deg: float | None = None,
    roll_deg: float | None = None,
    beam_gains: bool = False,
    **given: Any,
) -> Calibration:
    """Calibrate a sonar of the model coherent with frames of roughly level ground.

    Frames with poses are taken to be z above the ground, whose z is that of their heights or else 0, up to a common error of
    height, pitch and roll. Frames without poses are taken to share theirs.

    Args:
        frames: of a real or simulated sonar; linear, dB or gamma.
        base: source of what frames do not show, as in :func:`.fit_sonar`; its fields are the means of the priors.
        height_m: known height of the sonar over the ground, the median over frames [m].
        pitch_deg: known pitch, the median over frames [deg].
        roll_deg: known roll, the median over frames [deg].
        beam_gains: whether to fit the gain of every beam, besides the taper.
        given: known fields of the sonar, which are not fitted.

    Raises:
        MitsonarError: frames that :func:`.fit_sonar` refuses; a sonar without a pattern over elevation; frames that do not
            show level ground above the noise.
    """
    fit = fit_sonar(frames, base, **given)
    sonar = fit.sonar.replace(**given)
    if sonar.vertical_pattern == "box":
        raise MitsonarError(
            "a calibration needs a pattern over elevation: got elevation_pattern box; set it to two_way or receive"
        )
    known = {"height_m": height_m, "pitch_deg": pitch_deg, "roll_deg": roll_deg}
    known |= {name: given.get(name) for name in INSTRUMENT}
    if "crosstalk_db" in given and given["crosstalk_db"] is None:
        known["crosstalk_db"] = NO_CROSSTALK_DB
    if "gain_exponent" in given:
        known["range_exponent"] = 0.0
    fixed = {name: float(value) for name, value in known.items() if value is not None}
    if not fixed.get("height_m", 1.0) > 0:
        raise MitsonarError(f"the height must be positive: got {height_m:g} m; give the height over the ground")
    # 1. All frames give the result.
    frames = _over_ground(frames)
    reference = reference_of(frames)
    problem = GroundProblem(frames, sonar, fit, reference, each_beam=beam_gains)
    solution = problem.solve(fixed, beam_gains=beam_gains)
    problem.check(solution)
    # 2. Odd frames judge what even frames give, by this model and by the sonar of `sonar fit` at a fitted place.
    held_out = None
    if len(frames) > 1:
        halves = [frames.select(np.arange(k, len(frames), 2)) for k in (0, 1)]
        even, odd = (GroundProblem(half, sonar, fit, reference, each_beam=beam_gains) for half in halves)
        place = {name: value for name, value in fixed.items() if name not in INSTRUMENT}
        nominal = {name: problem.start[name] for name in INSTRUMENT}
        if sonar.crosstalk_db is None:
            nominal["crosstalk_db"] = NO_CROSSTALK_DB
        solutions = [
            even.solve(fixed, solution.values, beam_gains=beam_gains),
            even.solve(nominal | place, solution.values),
        ]
        looks = [even.looks_of_frame(one) for one in solutions]
        held_out = dict(zip(("calibrated", "sonar fit"), odd.scores(solutions, looks), strict=True))
    return _result(problem, solution, fit, fixed, held_out)


def _over_ground(frames: SonarFrames) -> SonarFrames:
    """Return the frames with z over the ground, which lies at the median of what their heights give."""
    if frames.poses is None or frames.height_m is None or not np.isfinite(frames.height_m).any():
        return frames
    ground_m = float(np.nanmedian(frames.poses[:, 2] - frames.height_m))
    return replace(frames, poses=frames.poses - np.array([0, 0, ground_m, 0, 0, 0]))


def _result(
    problem: GroundProblem,
    solution: GroundSolution,
    fit: SonarFit,
    fixed: dict[str, float],
    held_out: dict[str, tuple[float, float]] | None,
) -> Calibration:
    """Return the calibration of a solution, and the sonar with the fields that the frames determine."""
    std = np.sqrt(np.diag(solution.covariance))
    parameters, notes = {}, []
    for k, (name, unit) in enumerate(FIELDS.items()):
        value = solution.values[name]
        prior = problem.prior_std[name] * (abs(value) if name in POSITIVE else 1.0)
        most = CERTAIN_LEAK_DB if name == "crosstalk_db" else DETERMINED * prior
        determined = name not in fixed and bool(std[k] < most)
        parameters[name] = Calibrated(value, float(std[k]), unit, determined or name in fixed)
        if name in fixed or determined or name == "crosstalk_db":  # which has no effect where it is not determined
            continue
        correlation = solution.covariance[k] / np.maximum(std * std[k], 1e-300)
        correlation[[k, 0]] = 0.0
        partner = int(np.abs(correlation).argmax())
        notes.append(
            f"{name} is not determined: {std[k] / prior:.0%} of the uncertainty before the fit remains; it trades most with "
            f"{list(FIELDS)[partner]} (correlation {correlation[partner]:+.2f}); give it, or frames from other heights and "
            "pitches"
        )
    # the sonar's fields, except those that only the prior determines
    fields: dict[str, Any] = {}
    for name in ("taper_db", "elevation_fov_deg", "absorption_db_per_m", "noise_level_db", "crosstalk_db"):
        one = parameters[name]
        if name == "absorption_db_per_m" and fit.sonar.gain_absorption:
            continue  # the simulator's gain would undo it
        if name not in fixed and one.determined:
            least = -math.inf if name.endswith("_db") else 0.0
            fields[name] = float(f"{max(one.value, least):.4g}")
    if solution.fitted_gains:
        fields["stripes_db"] = round(float(solution.gain_db.std()), 2)
    return Calibration(
        fit=replace(fit, sonar=fit.sonar.replace(**fields)),
        parameters=parameters,
        covariance=solution.covariance,
        looks=solution.looks,
        beam_gain_db=solution.gain_db if solution.fitted_gains else None,
        held_out=held_out,
        outliers=1 - float(solution.used.sum() / problem.valid.sum()),
        notes=notes,
    )
