"""A checkpoint as ONNX, for programs without torch. The file's metadata describe inputs and outputs."""

from __future__ import annotations

import importlib.util
import json
import logging
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from mitsonar.datasets.samples import ground_at
from mitsonar.errors import MitsonarError
from mitsonar.instruments.sounder import sonar_from
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.networks.create import NETWORKS
from mitsonar.networks.gaussian_head import GaussianHead

__all__ = ["onnx_of"]


def onnx_of(checkpoint: Checkpoint, batch: int | None = None) -> bytes:
    """Write a checkpoint as ONNX, and return the file's content.

    Inputs: ``image`` in the checkpoint's arrangement, grey values 0..1, and ``cartesian`` for ``both`` coordinates;
    for networks that know the geometry also the tables of :func:`~mitsonar.datasets.samples.ground_at`, by name.
    Outputs: ``labels``, or ``motion`` and its ``covariance``.

    Args:
        checkpoint: of the network.
        batch: number of samples of a batch; None: any number.

    Raises:
        MitsonarError: ``onnx`` or ``onnxscript`` is missing, or torch cannot write the network.
    """
    missing = [name for name in ("onnx", "onnxscript") if importlib.util.find_spec(name) is None]
    if missing:
        raise MitsonarError(f"writing ONNX needs {' and '.join(missing)}: pip install 'mitsonar[learn]'")
    import onnx

    network = _Named(checkpoint.build(), checkpoint.arrangement["ground"]).eval()
    inputs = _inputs(checkpoint, 3 if batch is None else batch)
    shapes = None
    if batch is None:
        shapes = {"inputs": {name: {0: torch.export.Dim("batch")} for name in inputs}}
    outputs = ["motion", "covariance"] if NETWORKS[checkpoint.network].has_covariance else ["labels"]
    try:
        with _quiet(), torch.no_grad():
            network(inputs)  # fills the networks' caches before the tracer passes empty tensors
            traced = torch.export.export(network, (), {"inputs": inputs}, dynamic_shapes=shapes)
            traced = traced.run_decompositions({**torch.export.default_decompositions(), **WITHOUT})
            program = torch.onnx.export(
                traced,
                dynamo=True,
                verbose=False,
                input_names=list(inputs),
                output_names=outputs,
                external_data=False,
            )
    except (RuntimeError, torch.onnx.errors.OnnxExporterError) as error:
        cause = str(error.__cause__ or error).splitlines() or [type(error).__name__]
        how = "of any number of samples at a time; give a number" if batch is None else f"of {batch} samples at a time"
        raise MitsonarError(f"torch cannot write this {checkpoint.network} as ONNX {how} ({cause[0]})") from None
    assert program is not None
    model = program.model_proto
    onnx.helper.set_model_props(model, _about(checkpoint))
    return bytes(model.SerializeToString())


class _Named(nn.Module):
    """A network whose inputs are passed by name."""

    def __init__(self, network: nn.Module, ground: bool) -> None:
        super().__init__()
        self.network, self.ground = network, ground

    def forward(self, inputs: dict[str, Tensor]) -> Tensor | tuple[Tensor, Tensor]:
        """Return labels, or a motion and its covariance."""
        rest = dict(inputs)
        image = rest.pop("image")
        answer = self.network(image, rest) if self.ground else self.network(image, *rest.values())
        return tuple(answer) if isinstance(answer, GaussianHead) else answer  # type: ignore[return-value]


def _inputs(checkpoint: Checkpoint, batch: int) -> dict[str, Tensor]:
    """Make a batch of the network's inputs by name, with noise in place of frames."""
    made = torch.Generator().manual_seed(0)
    if not checkpoint.arrangement["ground"]:
        options = checkpoint.options
        names = {"image": "size", "cartesian": "cartesian_size"}
        sizes = {name: options[size] for name, size in names.items() if size in options}
        if checkpoint.arrangement["coordinates"] == "cartesian":
            sizes = {"image": options["size"]}
        return {name: torch.rand((batch, options.get("channels", 1), *size), generator=made) for name, size in sizes.items()}
    sonar = sonar_from(dict(checkpoint.data_recipe["sonar"]))
    height, pitch = sum(checkpoint.trained_at["height_m"]) / 2, checkpoint.trained_at["pitch_deg"]
    ground = ground_at(sonar.range_m, sonar.bearing_rad, sonar.bearing, height, math.radians(pitch))
    image = torch.rand((batch, 2, sonar.range_bins, sonar.beams), generator=made)
    tables = {name: torch.from_numpy(values) for name, values in ground.items()}
    return {"image": image} | {name: values.expand(batch, *values.shape).contiguous() for name, values in tables.items()}


def _about(checkpoint: Checkpoint) -> dict[str, str]:
    """Return the metadata of the file; tables as JSON."""
    texts = ("network", "model", "noise", "data", "digest")
    tables = ("options", "arrangement", "labels", "sonar", "trained_at", "metrics", "trained")
    about: dict[str, str] = {name: getattr(checkpoint, name) for name in texts}
    about |= {name: json.dumps(getattr(checkpoint, name)) for name in tables}
    return about | {"mitsonar_version": checkpoint.version}


def _solved(matrix: Tensor, wanted: Tensor, **options: object) -> Tensor:
    """Solve systems with positive definite matrices ``(..., 3, 3)`` by elimination."""
    size = matrix.shape[-1]
    rows = [torch.cat([matrix[..., k, :], wanted[..., k, :]], dim=-1) for k in range(size)]
    for k in range(size):
        rows[k] = rows[k] / rows[k][..., k : k + 1]
        rows = [row if j == k else row - row[..., k : k + 1] * rows[k] for j, row in enumerate(rows)]
    return torch.stack(rows, dim=-2)[..., size:]


def _inverted(matrix: Tensor) -> Tensor:
    """Invert positive definite matrices ``(..., 3, 3)`` by elimination."""
    return _solved(matrix, torch.eye(matrix.shape[-1], dtype=matrix.dtype).expand(matrix.shape))


WITHOUT = {torch.ops.aten.linalg_solve.default: _solved, torch.ops.aten.linalg_inv.default: _inverted}
"""Operations that ONNX lacks, and what replaces them."""


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress torch's remarks on packages that are not needed, and on its own deprecations."""
    logs = [logging.getLogger(name) for name in ("torch.onnx", "onnx_ir", "onnxscript")]
    had = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for log, level in zip(logs, had, strict=True):
            log.setLevel(level)
