"""Render one ping of mutants of a scene: ``python scene_mutants.py FOLDER FIRST COUNT``, a line of JSON for each."""

from __future__ import annotations

import json
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from mutations import changed_scene

SCENE = """<scene version="3.0.0">
    <default name="size" value="8"/>
    <integrator type="echo"/>
    <sensor type="imaging_sonar">
        <integer name="beams" value="4"/><integer name="rays_per_beam" value="8"/><integer name="range_bins" value="16"/>
        <float name="range_max" value="8"/>
        <transform name="to_world"><lookat origin="0, 0, 3" target="0, 3, 0" up="0, 0, 1"/></transform>
    </sensor>
    <emitter type="constant"><float name="radiance" value="1"/></emitter>
    <texture type="cell_noise" id="cells"><float name="cells" value="64"/></texture>
    <bsdf type="acoustic_material" id="sand">
        <string name="material" value="sand"/><ref id="cells" name="reflectance"/>
    </bsdf>
    <bsdf type="twosided" id="both"><bsdf type="diffuse"><rgb name="reflectance" value="0.1, 0.2, 0.3"/></bsdf></bsdf>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><scale value="$size"/><rotate x="1" angle="5"/><translate z="-0.5"/></transform>
        <ref id="sand"/>
    </shape>
    <shape type="ply" id="seabed">
        <string name="filename" value="seabed.ply"/><boolean name="face_normals" value="true"/>
        <bsdf type="diffuse">
            <texture type="bitmap" name="reflectance"><string name="filename" value="grain.png"/></texture>
        </bsdf>
    </shape>
    <shape type="sphere" id="ball">
        <point name="center" x="0" y="3" z="0.5"/><float name="radius" value="0.5"/><ref id="both"/>
    </shape>
    <shape type="shapegroup" id="group"><shape type="cube"><bsdf type="diffuse"/></shape></shape>
    <shape type="instance"><ref id="group"/><transform name="to_world"><translate x="1" y="4"/></transform></shape>
</scene>
"""


def make_files(folder: Path) -> None:
    """Write what the scene names."""
    import trimesh
    from PIL import Image

    trimesh.creation.box((4, 4, 0.1)).export(folder / "seabed.ply")
    Image.fromarray(np.arange(64, dtype=np.uint8).reshape(8, 8)).save(folder / "grain.png")


def outcome_of(path: Path) -> str:
    """``read``, ``refused``, or the error that is neither."""
    from mitsonar import MitsonarError, Simulator, load_scene
    from mitsonar.simulation.scene import sonar_in

    try:
        scene = load_scene(path)
        result = sonar_in(scene)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            frames = Simulator(scene).render(np.array([result[1] if result else np.zeros(6)], dtype=float))
        assert np.isfinite(frames.image).all(), "the picture is not finite"
    except MitsonarError as error:
        return "refused" if 0 < len(str(error)) < 2000 else f"a refusal of {len(str(error))} letters"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "read"


def main(folder: Path, first: int, count: int) -> None:
    """Write the scene and its mutants into a folder, and print what becomes of each."""
    make_files(folder)
    for seed in range(first, first + count):
        content = SCENE.encode() if seed < 0 else changed_scene(np.random.default_rng(seed), SCENE.encode())
        (folder / "mutant.xml").write_bytes(content)
        print(json.dumps([seed, "began", 0]), flush=True)
        before = time.process_time()
        result = outcome_of(folder / "mutant.xml")
        print(json.dumps([seed, result, time.process_time() - before]), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
