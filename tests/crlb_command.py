"""The command ``mitsonar crlb``, in this process, and a floor for it."""

from __future__ import annotations

import typer
from typer.testing import CliRunner


def command(*arguments: object) -> tuple[int, str]:
    from mitsonar.cli.estimate import crlb

    app = typer.Typer()
    app.command()(crlb)
    done = CliRunner().invoke(app, [str(word) for word in arguments])
    return done.exit_code, done.output


def floor_scene(texture: str = "") -> str:
    """A sonar of 16 beams above a level floor."""
    return f"""<scene version="3.0.0"><sensor type="imaging_sonar">
  <integer name="beams" value="16"/><integer name="rays_per_beam" value="100"/><integer name="rays_across" value="2"/>
  <integer name="range_bins" value="64"/>
  <transform name="to_world"><lookat origin="0,0,2.5" target="0,3.57,0" up="0,0,1"/></transform></sensor>
<shape type="rectangle" id="floor"><transform name="to_world"><scale value="100"/></transform>
  <bsdf type="diffuse">{texture}</bsdf></shape></scene>"""
