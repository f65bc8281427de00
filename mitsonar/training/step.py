"""One step of training: network, loss and augmentation, as a Lightning module."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, cast

import lightning
import numpy as np
import torch
from torch import Tensor, nn

from mitsonar.config.training import Loss, TrainingRecipe
from mitsonar.datasets.arrangement import Labels
from mitsonar.errors import MitsonarError
from mitsonar.motion.composition import inverse
from mitsonar.motion.errors import AXES, Axis
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.networks.corrnet import GaussianHead, Ground, likelihood
from mitsonar.networks.create import NETWORKS, called, create_network, options_for
from mitsonar.networks.profilenet import check_portions
from mitsonar.training.data import STEP, Array, Batch, Material, Validation, batches, finished, seed_of

if TYPE_CHECKING:
    from torch.utils.data import DataLoader

    from mitsonar.training.data import BatchesInMemory, NetworkInput, NetworkOutput

__all__ = [
    "AUGMENTATIONS",
    "NetworkTraining",
    "augmented",
    "axes_of",
    "create_loss",
    "estimates",
    "network_for",
    "rmse_by_level",
    "squared_error",
]


def axes_of(labels: Labels) -> tuple[Axis, ...]:
    """Return the names and units of the estimates, which are a motion or a height."""
    known = {axis.name: axis for axis in (*AXES, Axis("height", "mm", 1e3))}
    return tuple(known[name.split()[0]] for name in labels.names)


def estimates(output: NetworkOutput, labels: Labels) -> Array:
    """Return the estimates of a network in SI units ``(batch, outputs)``; for a Gaussian head, the last mean."""
    if isinstance(output, GaussianHead):
        mean = output.mean if output.mean.dim() == 2 else output.mean[-1]
        return np.asarray(mean.detach().cpu().double().numpy())
    return labels.decode(output.detach().cpu().double().numpy())


def network_for(recipe: TrainingRecipe, material: Material) -> nn.Module:
    """Create the network of a recipe, with initial weights drawn from its seed, and check it with two samples.

    Raises:
        MitsonarError: the network or an option is unknown, or input, labels or loss do not fit the network.
    """
    name, options = recipe.network["name"], {key: value for key, value in recipe.network.items() if key != "name"}
    _check_recipe(name, recipe)
    _, inputs, truth = next(material.validation.batches(2))
    labels = torch.from_numpy(material.samples.labels.encode(truth))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        views = material.samples.described()["arrangement"]["views"]
        network = create_network(name, **{**options_for(name, inputs, labels, len(views)), **options})
    if name == "profilenet":
        check_portions(views)
    if recipe.start is not None:
        _load_weights(network, name, Checkpoint.load(recipe.start))
    _check_shapes(network, name, inputs, labels, material)
    return network.train()


def _check_recipe(name: str, recipe: TrainingRecipe) -> None:
    """Check that input, labels and loss fit a network.

    Raises:
        MitsonarError: they do not.
    """
    input_options = recipe.input.model_dump()
    for key, needed in getattr(NETWORKS.get(name), "needs", {}).items():
        if input_options[key] != needed:
            raise MitsonarError(
                f"network {name} needs input {key} {needed}: got {input_options[key]}; set input.{key}={str(needed).lower()}"
            )
    if getattr(NETWORKS.get(name), "has_covariance", False) != (recipe.loss.kind == "likelihood"):
        expected = (
            "likelihood, because it estimates a covariance"
            if recipe.loss.kind == "mse"
            else "mse, because it estimates no covariance"
        )
        raise MitsonarError(f"network {name} needs loss.kind {expected}: got {recipe.loss.kind}")
    if recipe.loss.kind == "likelihood" and recipe.labels != "raw":
        raise MitsonarError(f"loss.kind likelihood needs motions in metres: set labels: raw, got {recipe.labels}")


def _check_shapes(network: nn.Module, name: str, inputs: NetworkInput, labels: Tensor, material: Material) -> None:
    """Check that a network accepts the input and returns as many values as there are labels.

    Raises:
        MitsonarError: it does not.
    """
    try:
        with torch.no_grad():
            shape = estimates(called(network.eval(), inputs), material.samples.labels).shape
    except (RuntimeError, TypeError) as error:
        raise MitsonarError(
            f"network {name} cannot read this input: {str(error).splitlines()[0]}; change input or the network's options"
        ) from None
    except ValueError as error:
        if isinstance(error, MitsonarError):
            raise
        shape = (0, 0)  # a different number of labels cannot be decoded
    if shape != labels.shape:
        raise MitsonarError(
            f"network {name} does not return the {labels.shape[1]} values of the labels "
            f"({', '.join(material.samples.labels.names)}): omit its option outputs, or set it to {labels.shape[1]}"
        )


def _load_weights(network: nn.Module, name: str, checkpoint: Checkpoint) -> None:
    """Load the weights of a trained network from a checkpoint.

    Raises:
        MitsonarError: the checkpoint belongs to a different network, or has different options.
    """
    options = network.options
    if checkpoint.network != name or checkpoint.options != options:
        raise MitsonarError(
            f"start contains the weights of {checkpoint.network} {checkpoint.options}, but the recipe has {name} {options}: "
            "give a checkpoint of the same network"
        )
    network.load_state_dict(checkpoint.build().state_dict())


class NetworkTraining(lightning.LightningModule):
    """Training of a network; each step, including dropout, depends only on (recipe, step, weights).

    Args:
        network: network to train.
        recipe: training recipe.
        material: training and validation data.

    Attributes:
        epoch_steps: number of steps per epoch.
        steps: number of steps of the whole training.
        workers: number of processes that read or render.
        squares: mean squared errors of the last batch [m^2, m^2, rad^2].
    """

    def __init__(self, network: nn.Module, recipe: TrainingRecipe, material: Material) -> None:
        super().__init__()
        self.network, self.recipe, self.material, self.samples = network, recipe, material, material.samples
        self.loss = create_loss(recipe.loss, material.samples.labels)
        self.epoch_steps = max(1, material.epoch // recipe.batch)
        self.steps = recipe.length(self.epoch_steps)
        self.workers = 0
        self.squares: Array = np.zeros(len(material.samples.labels.names))

    def train_dataloader(self) -> DataLoader[Batch] | BatchesInMemory:
        """Return all batches from the next step to the end of training."""
        share = (self.trainer.global_rank, self.trainer.world_size)
        return batches(
            self.material, self.recipe, self.global_step, self.steps, device=self.device, workers=self.workers, share=share
        )

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Create the optimiser, Adam or AdamW; its learning rate is set before each step."""
        settings = self.recipe.optimiser
        optimiser_class: type[torch.optim.Adam] = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[settings.kind]
        return optimiser_class(self.network.parameters(), lr=settings.rate, weight_decay=settings.weight_decay, fused=True)

    @property
    def rate(self) -> float:
        """Return the learning rate of the next step."""
        return self.recipe.optimiser.rate_at(self.global_step, self.epoch_steps, self.steps)

    def on_train_batch_start(self, batch: Batch, batch_idx: int) -> None:
        """Set the learning rate and seed torch's random generator for this step."""
        optimiser = self.optimizers()
        for group in optimiser.param_groups:  # type: ignore[union-attr]
            group["lr"] = self.rate
        seed = seed_of(self.recipe.seed, STEP, self.global_step, self.global_rank)
        torch.default_generator.manual_seed(seed)  # torch.manual_seed also formats a traceback for each absent device
        if self.device.type == "cuda":
            torch.cuda.manual_seed(seed)

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        """Compute the loss of a batch.

        Raises:
            MitsonarError: the loss is not finite.
        """
        inputs, labels = finished(batch, self.samples, self.device)
        if self.recipe.augment:
            inputs, labels = augmented(cast("tuple[Tensor, Ground]", inputs), labels, self.recipe.augment)
        output = called(self.network, inputs)
        loss = self.loss(output, labels)
        if not math.isfinite(float(loss.detach())):
            raise MitsonarError(self._not_finite_message(batch, float(loss.detach())))
        truth = self.samples.labels.decode(labels.detach().cpu().double().numpy())
        self.squares = ((estimates(output, self.samples.labels) - truth) ** 2).mean(axis=0)
        return loss

    def _not_finite_message(self, batch: Batch, loss: float) -> str:
        epoch, position = divmod(self.global_step, self.epoch_steps)
        frames = ", ".join(map(str, batch["frames"].tolist()[:16]))
        return (
            f"the loss became {loss} in epoch {epoch + 1}, step {position + 1} of {self.epoch_steps} (step "
            f"{self.global_step + 1} overall), at learning rate {self.rate:.3g}, on the samples that begin at frames "
            f"{frames}: check them with `mitsonar dataset check`, set a lower optimiser.rate, or optimiser.clip=1; the "
            "last good state is kept"
        )


def rmse_by_level(
    network: nn.Module,
    validation: Validation,
    labels: Labels,
    batch: int,
    *,
    device: torch.device | str | None = None,
    context: AbstractContextManager[object] | None = None,
) -> tuple[dict[str, Array], Array]:
    """Compute the RMSE for each noise level ``(outputs,)`` [m, m, rad], and that of the constant estimate zero.

    The network is evaluated in evaluation mode. Its mode is restored afterwards.

    Args:
        network: network to validate.
        validation: validation samples.
        labels: encoding of the network's output.
        batch: number of samples per batch.
        device: device of the network.
        context: context manager for the precision of training.
    """
    squares: dict[str, list[Array]] = {level: [] for level in validation.arrangements}
    truths: list[Array] = []
    was_training = network.training
    network.eval()
    try:
        with torch.no_grad(), context or nullcontext():
            for level, inputs, truth in validation.batches(batch, device):
                squares[level].append((estimates(called(network, inputs), labels) - truth) ** 2)
                truths.append(truth**2)
    finally:
        network.train(was_training)
    means = {level: np.sqrt(np.concatenate(parts).mean(axis=0)) for level, parts in squares.items()}
    return means, np.asarray(np.sqrt(np.concatenate(truths).mean(axis=0)))


# ---------------- Losses


def squared_error(
    estimates: Tensor, labels: Tensor, *, penalty: float = 0.0, low: Tensor | float = -10.0, high: Tensor | float = 10.0
) -> Tensor:
    """Compute the squared-error loss of Almanza-Medina (3.4): eq. 3.1, or with a penalty eq. 3.3.

    It is the sum of squared errors and penalties, divided by 2 S W.

    Args:
        estimates: ``(S, W)`` in label units.
        labels: ``(S, W)`` in label units.
        penalty: eta of eq. 3.2.
        low: u_1 of eq. 3.2, a single value or one for each of the W labels.
        high: u_2 of eq. 3.2, a single value or one for each of the W labels.
    """
    square = (estimates - labels).square()
    if penalty:
        excess = (low - estimates).clamp(min=0) + (estimates - high).clamp(min=0)
        square = square + penalty * excess.square()
    return square.sum() / (2 * square.numel())


def create_loss(loss: Loss, labels: Labels) -> Callable[[NetworkOutput, Tensor], Tensor]:
    """Return the loss function of a recipe, which takes a network's output and labels ``(batch, outputs)``.

    It is the squared error, with or without a penalty, or the Gaussian likelihood.
    """
    if loss.kind == "likelihood":
        return _likelihood
    low, high = (torch.from_numpy(labels.encode(limit)) for limit in (labels.low, labels.high))
    if loss.bounds is not None:
        low, high = (torch.full_like(low, bound) for bound in loss.bounds)

    def regression(estimates: NetworkOutput, target: Tensor) -> Tensor:
        assert isinstance(estimates, Tensor)
        limits = {"low": low.to(estimates), "high": high.to(estimates)} if loss.penalty else {}
        return squared_error(estimates, target, penalty=loss.penalty, **limits)

    return regression


def _likelihood(estimates: NetworkOutput, target: Tensor) -> Tensor:
    assert isinstance(estimates, GaussianHead)
    return likelihood(estimates, target)


# ---------------- Data augmentation


STRANGERS = 0.05
"""Fraction of pairs whose second frame comes from another pair. These do not match, so their covariance must be large."""

Augmented = tuple[Tensor, Ground, Tensor]
"""Images ``(batch, 2, bins, beams)``, geometry of the ground, and motions ``(batch, 3)`` [m, m, rad]."""


def augmented(inputs: tuple[Tensor, Ground], labels: Tensor, kinds: Sequence[str]) -> tuple[tuple[Tensor, Ground], Tensor]:
    """Apply random augmentations, after which the motion is still known, to the inputs and labels of a batch.

    Random numbers come from torch's default generator.

    Args:
        inputs: images ``(batch, 2, bins, beams)`` and the geometry of the ground.
        labels: motions ``(batch, 3)`` [m, m, rad].
        kinds: keys of :data:`AUGMENTATIONS`, applied in this order.
    """
    images, ground = inputs
    batch = images, ground, labels
    for kind in kinds:
        batch = AUGMENTATIONS[kind](batch)
    images, ground, labels = batch
    return (images, ground), labels


def mirrored(batch: Augmented) -> Augmented:
    """Swap port and starboard in half of the pairs.

    This is valid for sonars without roll whose beams are symmetric about the axis.
    """
    images, ground, labels = batch
    chosen = _random_mask(labels, 0.5)
    images = torch.where(chosen[:, None, None, None], images.flip(-1), images)
    return images, ground, torch.where(chosen[:, None], labels * labels.new_tensor([-1.0, 1.0, -1.0]), labels)


def reversed_(batch: Augmented) -> Augmented:
    """Reverse the order of the frames in half of the pairs."""
    images, ground, labels = batch
    chosen = _random_mask(labels, 0.5)
    images = torch.where(chosen[:, None, None, None], images.flip(1), images)
    return images, ground, torch.where(chosen[:, None], inverse(labels), labels)


def strange(batch: Augmented) -> Augmented:
    """Replace the second frame by that of another pair in a fraction :data:`STRANGERS` of the pairs."""
    images, ground, labels = batch
    chosen = _random_mask(labels, STRANGERS)
    second = torch.where(chosen[:, None, None], images[:, 1].roll(1, dims=0), images[:, 1])
    return torch.stack([images[:, 0], second], dim=1), ground, labels


AUGMENTATIONS: dict[str, Callable[[Augmented], Augmented]] = {
    "mirror": mirrored,
    "reverse": reversed_,
    "strangers": strange,
}
"""Augmentations of a batch, keyed by name."""


def _random_mask(labels: Tensor, fraction: float) -> Tensor:
    """Draw a mask ``(batch,)`` of the pairs to change."""
    return torch.rand(len(labels), device=labels.device) < fraction
