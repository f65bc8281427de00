"""Rate and latency of `mitsonar serve`, with a client on loopback that publishes a pose and waits for its image.

    python benchmarks/bench_live.py [--quick] [--pings 100] [--scene objects] [--json FILE]

The client closes the loop: it publishes the next pose when the fan of the last one came. Latency is from just before the
pose is sent to the last byte of the fan's JPEG. 512 beams x 500 bins; the server is a process of its own. The server's own
time on the processors, a ping, does not depend on what else the machine does.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from mitsonar.bridges.live_client import LiveClient, image_of
from mitsonar.motion.trajectory import Trajectory
from mitsonar.simulation.scene import shipped_trajectory

CASES = (("physical", "draft"), ("physical", "standard"), ("coherent", "draft"), ("coherent", "standard"))


def main() -> None:
    """Measure each model and quality."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a few pings of a small sonar")
    parser.add_argument("--pings", type=int, default=100)
    parser.add_argument("--scene", default="objects")
    parser.add_argument("--sonar", default="oculus-m750d-750khz")
    parser.add_argument("--json", type=Path, help="also write the figures there")
    arguments = parser.parse_args()
    beams, bins = (64, 100) if arguments.quick else (512, 500)
    pings, cases = (5, CASES[:1]) if arguments.quick else (arguments.pings, CASES)
    rows = [measured(arguments.scene, arguments.sonar, beams, bins, pings, *case) for case in cases]
    print(f"{arguments.scene}, {arguments.sonar}, {beams} beams x {bins} bins, {len(os.sched_getaffinity(0))} cores")
    latency = ("latency, median [ms]", "95 %", "worst")
    columns = ("model", "quality", "rate [Hz]", *latency, "rendering [ms]", "processor [ms]", "fan [px]")
    print(f"| {' | '.join(columns)} |")
    print("|---|---|---|---|---|---|---|---|---|")
    for row in rows:
        print(
            "| {model} | {quality} | {rate_hz:.1f} | {median_ms:.0f} | {p95_ms:.0f} | {worst_ms:.0f} | {render_ms:.0f} | "
            "{cpu_ms:.0f} | {columns} x {rows} |".format(**row)
        )
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=2) + "\n")


def measured(scene: str, sonar: str, beams: int, bins: int, pings: int, model: str, quality: str) -> dict[str, Any]:
    """Start a server, send poses of the shipped path, and return the figures."""
    words = ["--set", f"beams={beams}", "--set", f"range_bins={bins}", "--model", model, "--quality", quality]
    command = [sys.executable, "-m", "mitsonar", "serve", scene, "--sonar", sonar, *words, "--port", "0"]
    process = subprocess.Popen([*command, "--trajectory", "shipped"], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        result = re.search(r"ws://127\.0\.0\.1:\d+", process.stdout.readline())
        assert result is not None, "the server did not start"
        with LiveClient(result[0], ("/sonar/fan", "/sonar/timing")) as client:
            return rounds(client, scene, pings, process.pid) | {"model": model, "quality": quality}
    finally:
        process.terminate()
        process.wait(timeout=60)


def rounds(client: LiveClient, scene: str, pings: int, server: int) -> dict[str, Any]:
    """Close the loop so many times. The first ten are not counted: the first ping compiles."""
    poses = Trajectory.load_tum(shipped_trajectory(scene)).poses
    latency, render, picture = [], [], b""
    begun, worked = time.perf_counter(), 0.0
    warm = 10
    for number in range(warm + pings):
        x, y, z, *angles = (float(value) for value in poses[number % len(poses)])
        pitch, roll, heading = np.degrees(angles)
        pose = {"x": x, "y": y, "z": z, "pitch": pitch, "roll": roll, "heading": heading, "id": number}
        if number == warm:
            begun, worked = time.perf_counter(), processor_ms(server)
        sent = time.perf_counter()
        client.publish(pose)
        fan, came = b"", 0.0
        while True:  # the fan of a ping comes before its timing
            message = client.receive(120)
            if message.topic == "/sonar/fan":
                fan, came = message.content, time.perf_counter()
                continue
            report = json.loads(message.content)
            if report["id"] == number:
                break
        picture = image_of(fan)
        if number >= warm:
            latency.append(1e3 * (came - sent))
            render.append(report["render_ms"])
    seconds, cpu_ms = time.perf_counter() - begun, (processor_ms(server) - worked) / pings
    columns, rows = Image.open(io.BytesIO(picture)).size
    median, p95, worst = np.percentile(latency, (50, 95, 100))
    result = {"rate_hz": pings / seconds, "median_ms": median, "p95_ms": p95, "worst_ms": worst, "cpu_ms": cpu_ms}
    return {**result, "render_ms": float(np.median(render)), "columns": columns, "rows": rows, "pings": pings}


def processor_ms(process: int) -> float:
    """Return the time that a process has had on the processors, all threads together; nan where it is not known."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return float("nan")
    return 1e3 * (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


if __name__ == "__main__":
    main()
