"""A picture linearised in what a fit looks for, reduced to triangles of a few dozen numbers."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from diffdisp.misfit import Clipped, Misfit, Robust, misfit

LEAST_SLOPE = 0.1
"""Mean slope of a robust loss at which nine tenths of all misfits would be outliers: no less."""


class Columns(NamedTuple):
    """The derivatives of a picture: a Jacobian of which each channel holds few columns.

    Unknowns are numbered: first the others, of scene and exposure, and then those of the index.

    Args:
        values: change of the picture along each column.
        unknown: which unknown a column belongs to.
        others: how many unknowns are not of the index.
        total: how many unknowns there are.
    """

    values: Float[np.ndarray, "channels blocks columns"]
    unknown: Int[np.ndarray, "channels columns"]
    others: int
    total: int

    def along(self, change: Float[np.ndarray, " total"]) -> Float[np.ndarray, "blocks channels"]:
        """The change of the picture with a change of the unknowns."""
        return np.einsum("cbk,ck->bc", self.values, change[self.unknown])

    @property
    def of_index(self) -> Float[np.ndarray, "channels blocks columns"]:
        """The columns of unknowns of the index."""
        return self.values[..., self.unknown[0] >= self.others]


class Linearised(NamedTuple):
    """A picture near some unknowns: residual + J a, both weighed, and J = Q R.

    Rows beneath the picture's hold the others near where they were: next to nothing, but what the
    picture says nothing of stays.

    Args:
        r: R.
        q: Qᵀ residual.
        meat: Qᵀ diag(residual²) Q: how the noise that is there enters q.
        white: the same for a noise of 1 in every value of the picture, without what holds the
            others.
        held: the part of `meat` that holds them: it makes their error the widest.
        cost: sum of squared residuals, weighed.
        seen: number of residuals that depend on the index.
        noise: root mean square of those, weighed.
        rms: root mean square of all residuals.
        explained: part of the variance of what depends on the index that the render explains.
        columns: J.
        picture: the render.
        score: picture minus target; of clipped values what they tell of it.
        pulls: what each value adds to the slope of the cost: Jᵀ pulls = Rᵀ q, J without weights.
    """

    r: Float[np.ndarray, "total total"]
    q: Float[np.ndarray, " total"]
    meat: Float[np.ndarray, "total total"]
    white: Float[np.ndarray, "total total"]
    held: Float[np.ndarray, "total total"]
    cost: float
    seen: int
    noise: float
    rms: float
    explained: float
    columns: Columns
    picture: Float[np.ndarray, "blocks channels"]
    score: Float[np.ndarray, "blocks channels"]
    pulls: Float[np.ndarray, "blocks channels"]

    @property
    def weight(self) -> np.ndarray:
        """How much the index changes the picture (blocks, channels)."""
        return np.max(np.abs(self.columns.of_index), axis=-1).T

    def moved(self, change: np.ndarray) -> "Linearised":
        """The same after a change (total,) of the unknowns, as far as the picture is linear."""
        q = self.q + self.r @ change
        # Where the change explains all there is, rounding may leave less than nothing.
        cost = max(self.cost + float(np.sum(q**2) - np.sum(self.q**2)), 0.0)
        rms = self.rms * np.sqrt(cost / self.cost) if self.cost > 0 else 0.0
        picture = self.picture + self.columns.along(change)
        return self._replace(q=q, cost=cost, rms=float(rms), picture=picture)

    def pulled(self, pulls: np.ndarray) -> np.ndarray:
        """What q (total,) would be if these were the pulls (blocks, channels)."""
        slope = np.zeros(self.columns.total)
        each = np.einsum("cbk,bc->ck", self.columns.values, pulls)
        np.add.at(slope, self.columns.unknown, each)
        return np.linalg.solve(self.r.T, slope)

    def eliminated(self, damping: float = 0.0) -> "Eliminated":
        """What is left for the index when the others take their best values.

        Args:
            damping: holds the others, as a part of what the picture says of each.
        """
        r, q, p = self.r, self.q, self.columns.others
        if damping and p:
            held = np.diag(np.linalg.norm(r, axis=0) * np.sqrt(damping))[:p]
            q = np.concatenate([q, np.zeros(p)])
            basis, r = _qr(np.concatenate([r, held]))
            q = basis.T @ q
        return Eliminated(r[p:, p:], q[p:], r[:p, :p], r[:p, p:], q[:p])


class Eliminated(NamedTuple):
    """A linearised picture as a problem in the index alone, and what the others do then.

    For each change of the index the others take the values that lower the squares most: so the
    index is told with all that it costs not to know them.

    Args:
        r: of the index: J = Q R.
        q: of the index: Qᵀ residual.
        own: R of the others.
        mixed: what the index adds to their rows of R.
        others_q: their part of Qᵀ residual.

    Source:
        Golub and Pereyra, SIAM J. Numer. Anal. 10 (1973) 413, variable projection.
    """

    r: Float[np.ndarray, "index index"]
    q: Float[np.ndarray, " index"]
    own: Float[np.ndarray, "others others"]
    mixed: Float[np.ndarray, "others index"]
    others_q: Float[np.ndarray, " others"]

    def others(self, change: Float[np.ndarray, " index"]) -> Float[np.ndarray, " others"]:
        """The change of the others that belongs to one of the index."""
        return -np.linalg.solve(self.own, self.others_q + self.mixed @ change)


def linearise(
    picture: Float[np.ndarray, "blocks channels"],
    target: Float[np.ndarray, "blocks channels"],
    columns: Columns,
    weights: Float[np.ndarray, "blocks 1"],
    widest: float,
    clipped: Clipped | None = None,
    robust: Robust | None = None,
) -> Linearised:
    """A picture and its derivatives, reduced to what a step needs.

    Args:
        picture: the render.
        target: what it should be.
        columns: its derivatives.
        weights: of each block's squared residuals, within [0, 1].
        widest: standard deviation of an other of which the picture says nothing, in its unit.
        clipped: values of the target that were cut off, if any.
        robust: what takes the place of squares, if anything. Residuals are then what pulls of
            each, over the mean slope of that pull: a step, q and meat are those of the
            M-estimate, and only `picture`, `score` and `rms` know the outliers as they are.

    Source:
        Huber, Robust Statistics (Wiley, 1981): modified residuals, section 7.8; the covariance of
        an M-estimate, section 7.6, here without equal variances.
    """
    plain = picture - target
    told = Misfit(plain, plain, np.ones_like(plain), plain**2)
    if clipped is not None:
        told = misfit(picture, target, clipped)
    root = np.sqrt(weights * told.curvature)
    residual, score = root * told.residual, np.sqrt(weights) * told.score
    cost, pull = weights * told.cost, np.ones_like(plain)
    if robust is not None:
        pull, slope, height = robust.influence(score)
        cost = cost * height
        # Where the index shows most, the slopes of the pulls count most.
        count = np.max(np.abs(columns.of_index), axis=-1).T ** 2 * weights * told.curvature
        mean = float(np.sum(slope * count) / max(np.sum(count), 1e-300))
        residual, score = (pull / max(mean, LEAST_SLOPE) * off for off in (residual, score))
    seen = np.any(columns.of_index != 0, axis=-1).T
    count, total = int(seen.sum()), columns.total
    # A weight makes up for what is wrong with a value beside the noise: weighed, all have its size.
    effective = float(np.sum(seen * (weights > 0) * told.curvature))
    noise = float(np.sqrt(np.sum(score[seen] ** 2) / max(effective - total, 1.0)))
    contrast = np.sum((target[seen] - np.mean(target[seen])) ** 2) if count else 1.0
    explained = 1 - float(np.sum((pull * told.score)[seen] ** 2)) / max(float(contrast), 1e-300)
    near = max(noise, 1e-9 * float(np.max(np.abs(target), initial=1e-300))) / widest
    # Each channel by itself, and then their triangles: most unknowns are of one channel alone.
    basis, triangles = _qr(columns.values * root.T[..., None])
    errors = residual.T
    q = np.einsum("cbk,cb->ck", basis, errors)
    meat, white = (
        np.einsum("cbk,cb,cbl->ckl", basis, squares, basis, optimize=True)
        for squares in (errors**2, np.broadcast_to(weights.T, errors.shape))
    )
    # The variance of a clipped value's score is its curvature: the two are of one likelihood.
    channels, width = q.shape
    rows = np.zeros((channels * width + columns.others, total))
    within, without = (np.zeros((len(rows), len(rows))) for _ in range(2))
    beneath = np.zeros(len(rows))
    for channel in range(channels):
        some = slice(channel * width, (channel + 1) * width)
        rows[some, columns.unknown[channel]] = triangles[channel]
        within[some, some], without[some, some] = meat[channel], white[channel]
    rows[channels * width :, : columns.others] = near * np.eye(columns.others)
    beneath[channels * width :] = (near * widest) ** 2
    whole, r = _qr(rows)
    held = (whole.T * beneath) @ whole
    return Linearised(
        r,
        whole.T @ np.concatenate([q.ravel(), np.zeros(columns.others)]),
        whole.T @ within @ whole + held,
        whole.T @ without @ whole,
        held,
        float(np.sum(cost)),
        count,
        noise,
        float(np.sqrt(np.mean(told.score**2))),
        explained,
        columns,
        picture,
        told.score,
        root * residual,
    )


def _qr(matrix: Float[np.ndarray, "*n rows columns"]) -> tuple[np.ndarray, np.ndarray]:
    """Q and R with as many rows as columns; Q without what belongs to a column of zeros."""
    lacking = max(matrix.shape[-1] - matrix.shape[-2], 0)
    padding = [(0, 0)] * (matrix.ndim - 2) + [(0, lacking), (0, 0)]
    basis, r = np.linalg.qr(np.pad(matrix, padding) if lacking else matrix)
    basis = basis[..., : matrix.shape[-2], :]
    some = np.any(matrix != 0, axis=-2, keepdims=True)
    return np.where(some, basis, 0.0), r
