"""Make the trajectories to fly in the shipped scenes (TUM files); each begins where its scene's own sonar is.

Run `python trajectories.py .` in this folder after a change; `--quick` only compares them with the shipped ones.
"""

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mitsonar import Pose, Trajectory


def pose(x: float, y: float, z: float, pitch_deg: float, heading_deg: float = 0.0) -> Pose:
    """Return a pose without roll [m, deg]."""
    return Pose.from_degrees((x, y, z, pitch_deg, 0, heading_deg))


def arc(centre: tuple[float, float], start: Pose, turn_deg: float, frames: int, rate_hz: float) -> Trajectory:
    """Return an arc around a point [m], clockwise from above for a turn above 0, with the point always ahead."""
    turn = np.radians(np.linspace(0, turn_deg, frames))
    x, y = start.x - centre[0], start.y - centre[1]
    poses = np.tile(start, (frames, 1))
    poses[:, 0] = centre[0] + x * np.cos(turn) + y * np.sin(turn)
    poses[:, 1] = centre[1] - x * np.sin(turn) + y * np.cos(turn)
    poses[:, 5] += turn
    return Trajectory(poses, np.arange(frames) / rate_hz)


def flat_floor() -> Trajectory:
    """Return a path 0.8 m ahead and 0.3 m down."""
    return Trajectory.between(pose(0, 0, 2.5, 35), pose(0, 0.8, 2.2, 35), 30, 10)


def pattern() -> Trajectory:
    """Return run 2 of Almanza-Medina, 2.3: 5 m sideways and 2.3 m forward; about every fifth of its 300 frames."""
    return Trajectory.between(pose(-2.5, -4.85, 2.5, 35), pose(2.5, -2.55, 2.5, 35), 60, 21 / 5)


def objects() -> Trajectory:
    """Return a path sideways along the row: cannon, barrel, boat."""
    return Trajectory.between(pose(-3.4, -4.6, 2.2, 25), pose(3.4, -4.6, 2.2, 25), 60, 21 / 5)


def sunken_ship() -> Trajectory:
    """Return an eighth of a circle from the ship's port side to its bow."""
    return arc((0.7, -1.0), pose(2.2, 20.45, 14, 34, 184), 45, 45, 2)


def observatory() -> Trajectory:
    """Return a sixth of a circle around the node."""
    return arc((0.0, 0.0), pose(0, -13.5, 7, 32), 60, 45, 2)


def hydrophones() -> Trajectory:
    """Return a path 1 m ahead and 0.5 m to starboard, for the imaging sonar; `mitsonar impulse` flies courses."""
    return Trajectory.between(pose(0, 0, 2.5, 35), pose(0.5, 1.0, 2.5, 35), 45, 10)


TRAJECTORIES: dict[str, Callable[[], Trajectory]] = {
    "flat_floor": flat_floor,
    "pattern": pattern,
    "objects": objects,
    "sunken_ship": sunken_ship,
    "observatory": observatory,
    "hydrophones": hydrophones,
}


def main() -> None:
    """Write every trajectory into a folder, or compare them with those that are shipped."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, nargs="?", help="folder for the TUM files")
    parser.add_argument("--quick", action="store_true", help="compare with the shipped files instead")
    arguments = parser.parse_args()
    if arguments.quick:
        return compare()
    if arguments.out is None:
        parser.error("a folder is missing: give OUT, or --quick")
    write(arguments.out)


def write(folder: Path) -> None:
    """Write every trajectory."""
    for name, trajectory in TRAJECTORIES.items():
        trajectory().save_tum(folder / f"{name}.tum")


def compare() -> None:
    """Compare with the shipped files.

    Raises:
        SystemExit: one differs by more than rounding.
    """
    shipped = Path(__file__).resolve().parent
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder))
        for name in TRAJECTORIES:
            result, had = (np.loadtxt(path / f"{name}.tum") for path in (Path(folder), shipped))
            if result.shape != had.shape or not np.allclose(result, had, atol=1e-6):
                raise SystemExit(f"{name}.tum is not what is made now: run `python trajectories.py .`")
            print(f"{name}.tum: {len(result)} poses, as shipped")


if __name__ == "__main__":
    main()
