"""Cost of several bounces in impulse responses: ms of processor time a response with 1, 2 and 3, in a shallow guide.

python benchmarks/bench_bounces.py
python benchmarks/bench_bounces.py --quick    # a small guide, within seconds
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from mitsonar import ChannelSimulator, ChannelSonar
from mitsonar.instruments.channel_sonar import FieldOfView, Hydrophone
from mitsonar.simulation.variant import ensure_variant, use_threads


def main() -> None:
    """Print a row for each number of bounces."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small guide")
    parser.add_argument("--threads", type=int, default=1)
    asked = parser.parse_args()
    ensure_variant()
    use_threads(asked.threads)
    import mitsuba as mi

    half, pings = (3.0, 2) if asked.quick else (8.0, 12)
    place, bsdf = mi.ScalarTransform4f(), {"type": "diffuse"}
    scene = mi.load_dict(
        {
            "type": "scene",
            "seabed": {"type": "rectangle", "bsdf": bsdf, "to_world": place.scale(half)},
            "surface": {"type": "rectangle", "bsdf": bsdf, "to_world": place.translate([0, 0, 12]).scale(4 * half)},
        },
        optimize=False,
    )
    receiver = Hydrophone(name="one", position=(0.3, 0.2, 0.0), field=FieldOfView(shape="all"))
    poses = np.zeros((pings, 6))
    poses[:, 2] = 8.0
    for bounces in (1, 2, 3):
        sonar = ChannelSonar(
            receivers=(receiver,), bounces=bounces, range_max=60.0, frequency_step_hz=5.0, points_per_m2=100.0
        )
        made = ChannelSimulator(scene, sonar, mirrors={"surface": (-1.0, 0.0), "seabed": (0.3, 0.003)})
        list(made.pings(poses[:2]))
        begun = time.process_time()
        parts = list(made.pings(poses))
        spent = 1e3 * (time.process_time() - begun) / pings
        echoes = int(np.concatenate([part.echoes for part in parts]).mean())
        print(f"bounces {bounces}: {len(made.ways)} ways, {echoes:,} echoes, {spent:.1f} ms a response")


if __name__ == "__main__":
    main()
