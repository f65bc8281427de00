"""``mitsonar export``: a trained network as ONNX, for programs without torch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mitsonar.cli.console import answered, say
from mitsonar.cli.evaluate_command import Run, checkpoint_from
from mitsonar.errors import MitsonarError, meant

__all__ = ["export"]


@answered
def export(
    run: Run,
    onnx: Annotated[Path, typer.Option("--onnx", help="The .onnx file to write.")],
    batch: Annotated[str, typer.Option(help="Samples at a time: a number, or `dynamic` for any.")] = "dynamic",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Write a network with its weights as ONNX. The metadata of the file define inputs and outputs."""
    from mitsonar.io.run_directory import refuse_to_replace
    from mitsonar.io.whole_files import write_whole

    if batch != "dynamic" and not (batch.isdecimal() and int(batch) > 0):
        raise MitsonarError(f"--batch is a number of samples, or dynamic: got {batch!r}{meant(batch, ['dynamic'])}")
    if onnx.suffix.lower() != ".onnx" or not onnx.parent.is_dir():
        raise MitsonarError(f"--onnx must name an .onnx file in an existing folder: got {onnx}")
    refuse_to_replace(onnx, overwrite=overwrite, option="--onnx")
    checkpoint = checkpoint_from(run)
    from mitsonar.networks.onnx_export import onnx_of

    content = onnx_of(checkpoint, None if batch == "dynamic" else int(batch))
    write_whole(onnx, content)
    say(f"{checkpoint.network} of mitsonar {checkpoint.version}, {len(content):,} bytes: {onnx}")
