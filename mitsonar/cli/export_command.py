"""``mitsonar export``: a trained network as ONNX, for programs without torch, or as a smaller checkpoint."""

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
    onnx: Annotated[Path | None, typer.Option("--onnx", help="The .onnx file to write.")] = None,
    half: Annotated[
        Path | None, typer.Option("--half", help="The .ckpt file to write: the checkpoint with weights of half precision.")
    ] = None,
    batch: Annotated[str, typer.Option(help="Samples at a time of ONNX: a number, or `dynamic` for any.")] = "dynamic",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")] = False,
) -> None:
    """Write a network as ONNX, whose metadata define inputs and outputs, or as a checkpoint of half the size."""
    from mitsonar.io.files import write_whole

    if batch != "dynamic" and not (batch.isdecimal() and int(batch) > 0):
        raise MitsonarError(f"--batch is a number of samples, or dynamic: got {batch!r}{meant(batch, ['dynamic'])}")
    if onnx is None and half is None:
        raise MitsonarError("nothing to write: give --onnx FILE.onnx, --half FILE.ckpt, or both")
    for option, path, suffix in (("--onnx", onnx, ".onnx"), ("--half", half, ".ckpt")):
        if path is not None:
            _refuse_place(option, path, suffix, overwrite=overwrite)
    checkpoint = checkpoint_from(run)
    network = f"{checkpoint.network} of mitsonar {checkpoint.version}"
    if half is not None:
        content = checkpoint.halved().to_bytes()
        write_whole(half, content)
        say(f"{network}, {len(content):,} bytes: {half}")
    if onnx is not None:
        from mitsonar.networks.checkpoint import onnx_of

        content = onnx_of(checkpoint, None if batch == "dynamic" else int(batch))
        write_whole(onnx, content)
        say(f"{network}, {len(content):,} bytes: {onnx}")


def _refuse_place(option: str, path: Path, suffix: str, *, overwrite: bool) -> None:
    """Refuse a file that has another suffix, lies in no folder, or is there already.

    Raises:
        MitsonarError: it does.
    """
    from mitsonar.io.runs import refuse_to_replace

    if path.suffix.lower() != suffix or not path.parent.is_dir():
        raise MitsonarError(f"{option} must name an {suffix} file in an existing folder: got {path}")
    refuse_to_replace(path, overwrite=overwrite, option=option)
