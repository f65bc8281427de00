"""A network in training, as Lightning runs it: one step, one optimiser, and what the network says in physical units."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import lightning
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from mitsonar.config.training_recipe import TrainingRecipe
from mitsonar.datasets.arrangement import Labels
from mitsonar.errors import MitsonarError
from mitsonar.motion.motion_errors import AXES, Axis
from mitsonar.networks.checkpoint import Checkpoint
from mitsonar.networks.create import NETWORKS, called, create_network, options_for
from mitsonar.networks.gaussian_head import GaussianHead
from mitsonar.training.augment import augmented
from mitsonar.training.loss import create_loss
from mitsonar.training.training_data import STEP, Material, Validation, batches, finished, seed_of

__all__ = ["NetworkTraining", "axes_of", "network_for", "rmse_by_level", "said"]

Array = NDArray[np.float64]


def axes_of(labels: Labels) -> tuple[Axis, ...]:
    """Names and units of what is estimated: a motion's, or a height's."""
    known = {axis.name: axis for axis in (*AXES, Axis("height", "mm", 1e3))}
    return tuple(known[name.split()[0]] for name in labels.names)


def said(output: Tensor | GaussianHead, labels: Labels) -> Array:
    """What a network says, in SI ``(batch, outputs)``; of a law its (last) mean."""
    if isinstance(output, GaussianHead):
        mean = output.mean if output.mean.dim() == 2 else output.mean[-1]
        return np.asarray(mean.detach().cpu().double().numpy())
    return labels.decode(output.detach().cpu().double().numpy())


def network_for(recipe: TrainingRecipe, material: Material) -> nn.Module:
    """The network of a recipe, its weights drawn by the recipe's seed, tried on one sample.

    Raises:
        MitsonarError: an unknown network or option, an input, labels or loss that the network does not go with.
    """
    name, options = recipe.network["name"], {key: value for key, value in recipe.network.items() if key != "name"}
    words = recipe.input.model_dump()
    for word, needed in getattr(NETWORKS.get(name), "needs", {}).items():
        if words[word] != needed:
            raise MitsonarError(
                f"network {name} needs input {word} {needed}: got {words[word]}; set input.{word}={str(needed).lower()}"
            )
    if getattr(NETWORKS.get(name), "has_covariance", False) != (recipe.loss.kind == "likelihood"):
        right = "likelihood, it says how sure it is" if recipe.loss.kind == "mse" else "mse, it says no covariance"
        raise MitsonarError(f"network {name} is trained with loss.kind {right}: got {recipe.loss.kind}")
    if recipe.loss.kind == "likelihood" and recipe.labels != "raw":
        raise MitsonarError(f"loss.kind likelihood is of motions in metres: set labels: raw, got {recipe.labels}")
    _, inputs, truth = next(material.validation.batches(2))
    labels = torch.from_numpy(material.samples.labels.encode(truth))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(recipe.seed)
        receivers = len(material.samples.described()["arrangement"]["views"])
        network = create_network(name, **{**options_for(name, inputs, labels, receivers), **options})
    if recipe.start is not None:
        _begin_with(network, name, Checkpoint.load(recipe.start))
    try:
        with torch.no_grad():
            shape = said(called(network.eval(), inputs), material.samples.labels).shape
    except (RuntimeError, TypeError) as error:
        raise MitsonarError(
            f"network {name} cannot read this input: {str(error).splitlines()[0]}; change input or the network's options"
        ) from None
    except ValueError as error:
        if isinstance(error, MitsonarError):
            raise
        shape = (0, 0)  # labels of another number do not decode
    if shape != labels.shape:
        raise MitsonarError(
            f"network {name} gives another number of values than the {labels.shape[1]} of the labels "
            f"({', '.join(material.samples.labels.names)}): leave out its outputs, or set it to {labels.shape[1]}"
        )
    return network.train()


def _begin_with(network: nn.Module, name: str, checkpoint: Checkpoint) -> None:
    """Take the weights of a network that has learnt before.

    Raises:
        MitsonarError: they are another network's.
    """
    told: dict[str, Any] = network.options  # type: ignore[assignment]
    if checkpoint.network != name or checkpoint.options != told:
        raise MitsonarError(
            f"start holds the weights of {checkpoint.network} {checkpoint.options}, the recipe is of {name} {told}: give a "
            "checkpoint of the same network"
        )
    network.load_state_dict(checkpoint.build().state_dict())


class NetworkTraining(lightning.LightningModule):
    """One step of training is a function of (recipe, step, weights): dropout's draws too.

    Args:
        network: to be trained.
        recipe: of the training.
        material: what it learns from.

    Attributes:
        epoch_steps: steps of an epoch.
        steps: of the whole training.
        workers: processes that read or render.
        squares: squared errors of the last step, mean over the batch [m^2, m^2, rad^2].
    """

    def __init__(self, network: nn.Module, recipe: TrainingRecipe, material: Material) -> None:
        super().__init__()
        self.network, self.recipe, self.material, self.samples = network, recipe, material, material.samples
        self.loss = create_loss(recipe.loss, material.samples.labels)
        self.epoch_steps = max(1, material.epoch // recipe.batch)
        self.steps = recipe.length(self.epoch_steps)
        self.workers = 0
        self.squares: Array = np.zeros(len(material.samples.labels.names))

    def train_dataloader(self) -> Any:
        """All batches from the next step on."""
        share = (self.trainer.global_rank, self.trainer.world_size)
        return batches(
            self.material, self.recipe, self.global_step, self.steps, device=self.device, workers=self.workers, share=share
        )

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Adam or AdamW; the rate is set before each step."""
        told = self.recipe.optimiser
        kind = {"adam": torch.optim.Adam, "adamw": torch.optim.AdamW}[told.kind]
        return kind(self.network.parameters(), lr=told.rate, weight_decay=told.weight_decay, fused=True)

    @property
    def rate(self) -> float:
        """Learning rate of the next step."""
        return self.recipe.optimiser.rate_at(self.global_step, self.epoch_steps, self.steps)

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Rate and random numbers of this step."""
        optimiser = self.optimizers()
        for group in optimiser.param_groups:  # type: ignore[union-attr]
            group["lr"] = self.rate
        torch.manual_seed(seed_of(self.recipe.seed, STEP, self.global_step, self.global_rank))

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> Tensor:
        """The loss of a batch.

        Raises:
            MitsonarError: it is not finite.
        """
        inputs, labels = finished(batch, self.samples, self.device)
        if self.recipe.augment:
            inputs, labels = augmented(inputs, labels, self.recipe.augment)
        output = called(self.network, inputs)
        loss = self.loss(output, labels)
        if not math.isfinite(float(loss.detach())):
            raise MitsonarError(self._not_finite(batch, float(loss.detach())))
        truth = self.samples.labels.decode(labels.detach().cpu().double().numpy())
        self.squares = ((said(output, self.samples.labels) - truth) ** 2).mean(axis=0)
        return loss

    def _not_finite(self, batch: dict[str, Any], loss: float) -> str:
        epoch, place = divmod(self.global_step, self.epoch_steps)
        frames = ", ".join(map(str, batch["frames"].tolist()[:16]))
        return (
            f"the loss became {loss} in epoch {epoch + 1}, step {place + 1} of {self.epoch_steps} (step "
            f"{self.global_step + 1} in all), at learning rate {self.rate:.3g}, on the samples that begin at frames "
            f"{frames}: look at them with `mitsonar dataset check`, set a lower optimiser.rate, or optimiser.clip=1; the "
            "last good state is kept"
        )


def rmse_by_level(
    network: nn.Module,
    validation: Validation,
    labels: Labels,
    batch: int,
    *,
    device: torch.device | str | None = None,
    context: AbstractContextManager[Any] | None = None,
) -> tuple[dict[str, Array], Array]:
    """RMSE for each level of noise ``(outputs,)`` [m, m, rad], and that of answering no motion (or no height).

    The network is in evaluation mode meanwhile, and as it was afterwards.

    Args:
        network: to validate.
        validation: on what.
        labels: how its output is read.
        batch: samples at a time.
        device: that the network is on.
        context: of its precision.
    """
    squares: dict[str, list[Array]] = {level: [] for level in validation.arrangements}
    truths: list[Array] = []
    was = network.training
    network.eval()
    try:
        with torch.no_grad(), context or nullcontext():
            for level, inputs, truth in validation.batches(batch, device):
                squares[level].append((said(called(network, inputs), labels) - truth) ** 2)
                truths.append(truth**2)
    finally:
        network.train(was)
    means = {level: np.sqrt(np.concatenate(parts).mean(axis=0)) for level, parts in squares.items()}
    return means, np.asarray(np.sqrt(np.concatenate(truths).mean(axis=0)))
