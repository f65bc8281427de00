"""How ProfileNet estimates motion from the shifts between range profiles of a few portions of the field of view.

A vector is the range profile of a portion. If the ground comes nearer by a fraction of a range level, that fraction of each
level's echo moves to the preceding level. Therefore products of both profiles at neighbouring lags measure the shift, which
grows with the sine of incidence along the profile. The network computes such products of filtered profiles and averages
them over windows of range. A few layers combine those of all portions. The network is ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from mitsonar.datasets.modality import Fields
from mitsonar.errors import MitsonarError, short_repr
from mitsonar.instruments.views import SEGMENTS
from mitsonar.networks.blocks import Network, Size

__all__ = ["ProfileNet", "check_portions"]

FAINT = 1e-4
"""Variance below which a level is ignored, relative to the squared mean of all levels."""

QUIET = 1e-2
"""Power of filtered profiles below which products are ignored, relative to the variance of a level."""

SYMMETRIES: dict[int, list[tuple[tuple[int, ...], tuple[float, float, float]]]] = {
    # quadrants from fore-starboard clockwise: unchanged, mirrored sideways, fore and aft, both
    4: [
        ((0, 1, 2, 3), (1, 1, 1)),
        ((3, 2, 1, 0), (-1, 1, -1)),
        ((1, 0, 3, 2), (1, -1, -1)),
        ((2, 3, 0, 1), (-1, -1, 1)),
    ],
    # port and starboard half
    2: [((0, 1), (1, 1, 1)), ((1, 0), (-1, 1, -1))],
    1: [((0,), (1, 1, 1))],
}
"""Order of the portions in a mirrored world, and the signs of sideways, forward and yaw there, by number of portions."""

SIDEWAYS = {"starboard": "port", "port": "starboard"}
SIDEWAYS |= {f"{kind}{one}": f"{kind}{other}" for kind in "qc" for one, other in ("14", "41", "23", "32")}
FORE_AND_AFT = {f"{kind}{one}": f"{kind}{other}" for kind in "qc" for one, other in ("12", "21", "34", "43")}
"""The portion that shows the same in a mirrored world."""


def check_portions(views: Sequence[str]) -> None:
    """Check that portions of the field of view are in an order of which the symmetries hold.

    Raises:
        MitsonarError: they are not, so the network would learn wrong signs.
    """
    for (order, _), mirrored in zip(SYMMETRIES[len(views)][1:], (SIDEWAYS, FORE_AND_AFT), strict=False):
        if any(view in SEGMENTS and mirrored.get(view) != views[place] for view, place in zip(views, order, strict=True)):
            raise MitsonarError(
                "profilenet takes the whole view, starboard and port, or all quadrants or circular segments clockwise from "
                f"fore-starboard: got {', '.join(views)}; set input.views to these, or choose posenetvec"
            )


class ProfileNet(Network):
    """Network on range profiles: products of filtered profiles at a few lags, followed by a small perceptron.

    The products are averaged over windows of range. The estimate has the symmetries of the world by construction: it is the
    mean over mirrored portions and over both directions of time, each with its motion mirrored back. The symmetry is exact
    along the mean heading of both pings, which differs from the last heading by half the yaw, or 0.1 mm at most. There are
    four portions (quadrants or circular segments, from fore-starboard clockwise), two (halves, port first), or one.

    Args:
        outputs: number of estimates: sideways, forward, yaw.
        width: factor on filters and layers.
        dropout: rate in training, before each layer.
        size: range levels and columns; each portion has two columns.
        filters: number of filters of the profiles.
        taps: number of taps of a filter, odd.
        lags: largest lag of the products, in levels.
        windows: number of windows of range.

    Raises:
        MitsonarError: a value is out of range.
    """

    needs: ClassVar[Fields] = {"kind": "vector", "frames": 2, "layout": "side"}
    order: Tensor
    turned: Tensor

    def __init__(
        self,
        *,
        outputs: int = 3,
        width: float = 1.0,
        dropout: float = 0.1,
        size: Size = (1024, 8),
        filters: int = 12,
        taps: int = 7,
        lags: int = 6,
        windows: int = 16,
    ) -> None:
        super().__init__(outputs=outputs, width=width, dropout=dropout, size=size)
        levels, columns = self.options["size"]
        if columns % 2 or columns // 2 not in SYMMETRIES or outputs != 3:
            raise MitsonarError(
                "profilenet estimates sideways, forward and yaw from two vectors of each of one, two or four portions: got "
                f"{columns} columns and {outputs} outputs; choose views, or posenetvec"
            )
        for name, value, least in (("filters", filters, 1), ("taps", taps, 1), ("lags", lags, 1), ("windows", windows, 1)):
            if not isinstance(value, int) or value < least or (name == "taps" and value % 2 == 0):
                raise MitsonarError(
                    f"{name} must be a whole number of at least {least} (taps: odd): got {short_repr(value)}"
                )
        if windows > levels:
            raise MitsonarError(f"windows must be at most the {levels} levels: got {windows}")
        self.options |= {"filters": filters, "taps": taps, "lags": lags, "windows": windows}
        self.portions, self.lags, self.windows = columns // 2, lags, windows
        filter_count, shifts, hidden = (max(1, round(n * width)) for n in (filters, 48, 128))
        self.level = nn.BatchNorm1d(levels, eps=FAINT, affine=False)
        self.filter = nn.Conv1d(1, filter_count, taps, padding=taps // 2, bias=False)
        self.shift = nn.Linear(filter_count * (2 * lags + 1) * windows, shifts)
        self.change = nn.Linear(filter_count * windows, max(1, shifts // 3))
        values = self.portions * (shifts + max(1, shifts // 3))
        self.layers = nn.Sequential(
            *(nn.Dropout(dropout), nn.Linear(values, hidden), nn.GELU()),
            *(nn.Dropout(dropout), nn.Linear(hidden, hidden), nn.GELU()),
            nn.Linear(hidden, outputs),
        )
        symmetries = SYMMETRIES[self.portions]
        self.register_buffer("order", torch.tensor([order for order, _ in symmetries]), persistent=False)
        self.register_buffer("turned", torch.tensor([signs for _, signs in symmetries]), persistent=False)

    def forward(self, vectors: Tensor) -> Tensor:
        """Estimate labels ``(batch, 3)``, symmetric about zero motion, from vectors ``(batch, 1, levels, 2 portions)``.

        Raises:
            MitsonarError: the vectors have another size.
        """
        self.expect(vectors)
        # 1. Products at all lags measure shifts, differences of power measure gains; both relative to the mean power.
        first, second = self._filtered(vectors)
        power = self._windowed(first * first), self._windowed(second * second)
        mean = (power[0] + power[1]) / 2 + QUIET
        shared = self._products(first, second) / mean[..., None]
        gained = (power[0] - power[1]) / mean
        # 2. Features of each portion, forwards and backwards in time; reversal changes the sign of lags and gains.
        both = [
            torch.cat([self.shift(s.flatten(2)), self.change(g.flatten(2))], dim=-1)
            for s, g in ((shared, gained), (shared.flip(-1), -gained))
        ]
        features = torch.stack(both, dim=1)[:, :, self.order].flatten(3)  # batch, time, mirror, portions and values
        # 3. Estimate in each mirrored world, mirror the motions back, and average with the reversed ones.
        answers = self.layers(features) * self.turned
        return (answers[:, 0] - answers[:, 1]).mean(dim=1) / 2  # type: ignore[no-any-return]

    def _filtered(self, vectors: Tensor) -> tuple[Tensor, Tensor]:
        """Filter the profiles of both pings ``(batch, portions, filters, levels)``.

        Profiles are first divided by their mean, which removes the sonar's gain. Each level is then normalised by its
        standard deviation.
        """
        batch, _, levels, columns = vectors.shape
        vectors = vectors / vectors.mean(dim=(1, 2, 3), keepdim=True).clamp(min=1e-12)
        profiles = vectors[:, 0].transpose(1, 2).reshape(batch * columns, levels)
        filtered = self.filter(self.level(profiles)[:, None])
        filtered = functional.pad(filtered, (0, -levels % self.windows))
        parts = filtered.reshape(batch, self.portions, 2, *filtered.shape[1:])
        return parts[:, :, 0], parts[:, :, 1]

    def _products(self, first: Tensor, second: Tensor) -> Tensor:
        """Compute products at all lags, averaged over windows ``(batch, portions, filters, windows, lags)``.

        At a positive lag the farther level is in the second profile, at a negative lag in the first. Reversal of time
        exchanges the two.
        """
        levels = first.shape[-1]
        early, late = (functional.pad(one, (0, self.lags)) for one in (first, second))
        products = [early[..., lag : lag + levels] * second for lag in range(self.lags, 0, -1)]
        products += [first * late[..., lag : lag + levels] for lag in range(self.lags + 1)]
        return torch.stack([self._windowed(product) for product in products], dim=-1)

    def _windowed(self, values: Tensor) -> Tensor:
        """Average over windows of range ``(..., windows)``."""
        return values.reshape(*values.shape[:-1], self.windows, -1).mean(dim=-1)
