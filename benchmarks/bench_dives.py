"""`direct`, or another method, on pairs of frames of dives at many places, with what a vehicle knows and without.

    python benchmarks/bench_dives.py --out bench/dives [--sonars didson300,gemini-720is] [--flights gentle] [--worlds 12]
        [--method flow]

Frames of a dive see the same rocks, so that the NEES of a few worlds scatters. Here each pair has a place, a heading and a
moment of the flight of its own, five in each world; no world is one of `mitsonar benchmark odometry`. *all*: height, pitch
and roll of each frame are known; *attitude*: pitch and roll are, the height is that of first echoes; *pitch*: that of the
mount, nothing else. Prints a row for each sonar, texture and flight. Half an hour on two cores; `--quick`: two pairs.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

import mitsonar
from mitsonar.estimation.estimator import AnyEstimator, Estimate
from mitsonar.estimation.named import create_estimator
from mitsonar.instruments.sounder import preset
from mitsonar.motion.composition import motions
from mitsonar.motion.errors import MotionErrors, motion_errors
from mitsonar.motion.pose import Pose, mounted
from mitsonar.motion.trajectory import Trajectory
from mitsonar.records.frames import SonarFrames
from mitsonar.reproduction.odometry_benchmark import DIVE_HZ, DIVE_SONARS, FLIGHTS, SETS, TEXTURES, SimulatedSet, dive_course

SEED, PLACES, NEAR_M = 201, 5, 2.5
"""Seed of the first world; pairs in each; how far from its middle."""

KNOWN = ("all", "attitude", "pitch")

Array = NDArray[np.float64]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("bench/dives"), help="folder of the worlds")
    one_ping = [name for name in DIVE_SONARS if preset(name).ping_groups == 1]  # groups need the frames of a whole dive
    parser.add_argument("--sonars", default=",".join(one_ping))
    parser.add_argument("--flights", default=",".join(FLIGHTS))
    parser.add_argument("--worlds", type=int, default=12)
    parser.add_argument("--method", default="direct", help="a method that takes pitch_deg")
    parser.add_argument("--quick", action="store_true", help="two pairs of one sonar, kept nowhere: within a minute")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    print(f"| sonar | texture | flight | pairs | {' | NEES | '.join(KNOWN)} | NEES |\n{'|---' * (4 + 2 * len(KNOWN))}|")
    if not arguments.quick:
        sonars, flights = arguments.sonars.split(","), arguments.flights.split(",")
        return measure(arguments.out, sonars, flights, arguments.worlds, PLACES, arguments.method)
    with tempfile.TemporaryDirectory() as folder:
        measure(Path(folder), ["didson300"], ["gentle"], 1, 2, arguments.method)


def measure(out: Path, sonars: list[str], flights: list[str], worlds: int, places: int, method: str) -> None:
    """Print a row for each sonar, texture and flight."""
    for name in sonars:
        for flight in flights:
            for texture in TEXTURES:
                result = errors_of(out, SETS[f"dive-{name}-{flight}-3"], texture, worlds, places, method)
                cells = (f"{triple(one)} | {one.nees:.2f}" for one in result)
                print(f"| {name} | {texture} | {flight} | {worlds * places} | {' | '.join(cells)} |", flush=True)


def triple(errors: MotionErrors) -> str:
    """RMSE of each axis of valid estimates, and how many were rejected."""
    rejected = f", {errors.failures} rejected" if errors.failures else ""
    return "{:.2f} / {:.2f} / {:.3f}".format(*errors.believed) + rejected


def errors_of(out: Path, dive: SimulatedSet, texture: str, worlds: int, places: int, method: str) -> list[MotionErrors]:
    """Errors on the pairs of all worlds, by what is known."""
    true: list[Array] = []
    answers: dict[str, list[Estimate]] = {known: [] for known in KNOWN}
    for seed in range(SEED, SEED + worlds):
        for frames in pairs(out, replace(dive, seed=seed), texture, places):
            assert frames.poses is not None
            true.append(motions(frames.poses)[0])
            for known in KNOWN:
                answers[known].append(estimator_of(dive, known, method).estimate(reported(frames, known)))
    unknown = np.full((3, 3), np.nan)
    return [
        motion_errors(
            np.array([answer.motion for answer in given]),
            np.array(true),
            np.array([answer.valid for answer in given]),
            np.array([unknown if answer.covariance is None else answer.covariance for answer in given]),
        )
        for given in answers.values()
    ]


def pairs(out: Path, dive: SimulatedSet, texture: str, places: int) -> Iterator[SonarFrames]:
    """Two frames at each place of a world, as the vehicle moves from one ping to the next."""
    mount = Pose.from_degrees([0, 0, 0, dive.pitch_deg, 0, 0])
    path = Trajectory(mounted(vehicle(dive, places), mount), np.arange(2 * places) / DIVE_HZ)
    simulator = mitsonar.Simulator(
        mitsonar.load_scene(dive.world(out / f"world-{dive.seed}")), dive.sonar(texture, "preset")
    )
    frames = simulator.render(path, seed=dive.seed)
    yield from (frames.select(np.array([2 * place, 2 * place + 1])) for place in range(places))


def vehicle(dive: SimulatedSet, places: int) -> Array:
    """Poses of the vehicle, two a place ``(2 * places, 6)``: a moment of its course, turned and brought to the place."""
    assert dive.flight is not None
    rng = np.random.default_rng(7 * dive.seed)
    course = dive_course(600, DIVE_HZ, dive.seed, FLIGHTS[dive.flight])
    result = []
    for _ in range(places):
        position = int(rng.integers(0, len(course) - 2))
        pair, heading, place = (
            course[position : position + 2].copy(),
            rng.uniform(0, 2 * np.pi),
            rng.uniform(-NEAR_M, NEAR_M, 2),
        )
        turn = heading - pair[0, 5]
        turned = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        pair[:, :2] = place + (pair[:, :2] - pair[0, :2]) @ turned.T
        pair[:, 2] += dive.height_m
        pair[:, 5] += turn
        result.append(pair)
    return np.concatenate(result)


def reported(frames: SonarFrames, known: str) -> SonarFrames:
    """Return the frames with what is known."""
    if known == "all":
        return frames
    assert frames.poses is not None
    lean = frames.poses[:, 3:6] if known == "attitude" else None
    return replace(frames, poses=None, height_m=None, attitude_rad=lean)


def estimator_of(dive: SimulatedSet, known: str, method: str) -> AnyEstimator:
    """Return a method, given the pitch of the mount where nothing else is known."""
    return create_estimator(method, **({"pitch_rad": float(np.radians(dive.pitch_deg))} if known == "pitch" else {}))


if __name__ == "__main__":
    main()
