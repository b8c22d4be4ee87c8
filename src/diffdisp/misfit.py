"""What one value of a picture says against its render: how far off, and how surely."""

from typing import NamedTuple

import numpy as np
from jax.scipy.special import log_ndtr
from jaxtyping import Bool, Float

FAR_BELOW = -50.0
"""Standard deviations below a bound from which on a clipped value is an ordinary one, to 1/2500."""


class Clipped(NamedTuple):
    """Values that were cut off, as those at the top code of a .png: "at least that bright".

    Args:
        where: which they are.
        least: what they are at least.
        noise: standard deviation of the values around.
    """

    where: Bool[np.ndarray, "blocks channels"]
    least: Float[np.ndarray, "blocks channels"]
    noise: float


class Misfit(NamedTuple):
    """Minus the logarithm of a likelihood, as a parabola near a render.

    Args:
        score: its slope times the variance of the noise: render minus target of ordinary values.
        residual: render minus the parabola's lowest point.
        curvature: of the parabola, 1 for ordinary values; score = curvature · residual.
        cost: twice its height times the variance: the square of `score` for ordinary values.
    """

    score: Float[np.ndarray, "blocks channels"]
    residual: Float[np.ndarray, "blocks channels"]
    curvature: Float[np.ndarray, "blocks channels"]
    cost: Float[np.ndarray, "blocks channels"]


def misfit(
    picture: Float[np.ndarray, "blocks channels"],
    target: Float[np.ndarray, "blocks channels"],
    clipped: Clipped,
) -> Misfit:
    """How a render misses a target of which some values were cut off.

    To leave clipped values out would select pixels by what their noise happened to be, and bias
    what is left of the bright ones; to take them at their word would hold the render down. Their
    likelihood is the probability that radiance and noise together reach the bound. A render well
    above it agrees and learns nothing; well below, it is off as from any other value.

    Args:
        picture: the render.
        target: what it should be.
        clipped: which values of the target were cut off.

    Source:
        Tobin, Econometrica 26 (1958) 24, the likelihood of a limited variable.
    """
    plain, sigma = picture - target, clipped.noise
    z = np.where(clipped.where, (picture - clipped.least) / sigma, 0.0)
    far = z < FAR_BELOW
    near = np.where(far, 0.0, z)
    logarithm = np.asarray(log_ndtr(near))
    # The inverse Mills ratio: minus the slope of the likelihood's logarithm.
    mills = np.exp(-(near**2) / 2 - np.log(2 * np.pi) / 2 - logarithm)
    below = np.where(far, picture - clipped.least, -sigma * mills)
    curvature = np.where(far, 1.0, mills * (mills + near))
    # That of a render far above is 0; to divide by it is left to algebra.
    residual = np.where(far, below, -sigma / (mills + near))
    cost = np.where(far, below**2, -2 * sigma**2 * logarithm)
    return Misfit(
        *(
            np.where(clipped.where, told, ordinary)
            for told, ordinary in (
                (below, plain),
                (residual, plain),
                (curvature, 1.0),
                (cost, plain**2),
            )
        )
    )


class Robust(NamedTuple):
    """A loss that is a square for small misfits and lets outliers count for less.

    Args:
        kind: "huber", beyond whose cut a misfit pulls no stronger: convex, so that it can be
            trusted far from the answer; or "tukey", beyond whose cut it does not pull at all.
        spread: standard deviation of misfits that are no outliers.
    """

    kind: str
    spread: float

    @property
    def cut(self) -> float:
        """Where outliers begin, in spreads: normal noise then costs 5 % of the information.

        Source:
            Holland and Welsch, Commun. Statist. A 6 (1977) 813, table 1.
        """
        return {"huber": 1.345, "tukey": 4.685}[self.kind]

    def influence(
        self, misfits: Float[np.ndarray, "blocks channels"]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """How a misfit pulls, as parts of how it would as a square.

        Args:
            misfits: weighed.

        Returns:
            ψ(u) / u, the slope ψ'(u), and 2 ρ(u) / u², where u is a misfit in spreads.

        Source:
            Huber, Robust Statistics (Wiley, 1981), section 7.3; Beaton and Tukey,
            Technometrics 16 (1974) 147, the biweight.
        """
        part = np.abs(misfits) / (self.spread * self.cut)
        inside = part <= 1
        over = np.where(inside, 1.0, part)
        if self.kind == "huber":
            return 1 / over, 1.0 * inside, (2 - 1 / over) / over
        left = np.where(inside, 1 - part**2, 0.0)
        third = np.where(inside, 1 - part**2 + part**4 / 3, 1 / (3 * over**2))
        return left**2, left * np.where(inside, 1 - 5 * part**2, 0.0), third
