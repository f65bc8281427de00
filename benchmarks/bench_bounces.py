"""Cost of several bounces in impulse responses: ms of processor time a response with 1, 2 and 3, in a shallow guide.

The surface is flat, then a sea of 3 m/s in steps of 0.2 m.

python benchmarks/bench_bounces.py
python benchmarks/bench_bounces.py --quick    # a small guide, within seconds
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mitsonar import ChannelSimulator, ChannelSonar
from mitsonar.instruments.hydrophones import FieldOfView, Hydrophone
from mitsonar.simulation.device import ensure_variant, use_threads
from mitsonar.worlds.sea import SeaSurface

if TYPE_CHECKING:
    import mitsuba as mi

DEPTH = 12.0
CARRIER = 20e3


def main() -> None:
    """Print a row for each number of bounces."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small guide")
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    ensure_variant()
    use_threads(arguments.threads)
    import mitsuba as mi

    half, pings = (3.0, 2) if arguments.quick else (8.0, 12)
    place, bsdf = mi.ScalarTransform4f(), {"type": "diffuse"}
    seabed = {"type": "rectangle", "bsdf": bsdf, "to_world": place.scale(half)}
    flat = {"type": "rectangle", "bsdf": bsdf, "to_world": place.translate([0, 0, DEPTH]).scale(4 * half)}
    sea = SeaSurface(wind_m_s=3.0, size_m=8 * half, step_m=0.2, water_m=DEPTH)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "surface.ply"
        path.write_bytes(sea.surface(0).ply())
        waves = {"type": "ply", "filename": str(path), "face_normals": True, "bsdf": bsdf}
        scenes = {
            name: mi.load_dict({"type": "scene", "seabed": seabed, "surface": surface}, optimize=False)
            for name, surface in {"flat": flat, "waves": waves}.items()
        }
    for name, scene in scenes.items():
        assert isinstance(scene, mi.Scene)
        for bounces in (1, 2, 3):
            print(f"{name}, bounces {bounces}: {cost(scene, bounces, pings)}", flush=True)


def cost(scene: mi.Scene, bounces: int, pings: int) -> str:
    """Return kinds of paths, echoes and processor time of a response."""
    receiver = Hydrophone(name="one", position=(0.3, 0.2, 0.0), field=FieldOfView(shape="all"))
    poses = np.zeros((pings, 6))
    poses[:, 2] = 8.0
    keys = {"range_max": 60.0, "frequency_step_hz": 5.0, "points_per_m2": 100.0, "carrier_hz": CARRIER}
    sonar = ChannelSonar(receivers=(receiver,), bounces=bounces, **keys)
    # both without roughness, so that the surface has no scatterers of its own
    result = ChannelSimulator(scene, sonar, mirrors={"surface": (-1.0, 0.0), "seabed": (0.3, 0.003)})
    list(result.pings(poses[:2]))
    begun = time.process_time()
    parts = list(result.pings(poses))
    spent = 1e3 * (time.process_time() - begun) / pings
    echoes = int(np.concatenate([part.echoes for part in parts]).mean())
    return f"{len(result.kinds)} kinds of paths, {echoes:,} echoes, {spent:.1f} ms a response"


if __name__ == "__main__":
    main()
