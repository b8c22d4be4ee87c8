"""Vectors as three numbers, and roots whose gradients stay finite."""

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    Array = jax.Array | np.ndarray
else:  # what NumPy computes of arrays without axes are numbers of its own
    Array = jax.Array | np.ndarray | np.generic
"""An array of JAX or of NumPy."""

Real = Float[Array, "..."]
"""A real number, or one in each of many lanes: `vmap` makes many of one, with all derivatives.

Where none are wanted, what is written for one may as well be given arrays of lanes, which takes
half as long to trace.
"""

Triple = Float[Array, "3"]
"""Three numbers as data holds them: a point, a direction or a colour."""


class Vec3(NamedTuple):
    """A vector of three numbers.

    Of many lanes this is three long arrays; an array of three would become an (N, 3) array
    whose inner loop has length 3, which runs many times slower.
    """

    x: Real
    y: Real
    z: Real

    def __add__(self, other: "Vec3") -> "Vec3":  # type: ignore[override]
        """Sum of two vectors (not the concatenation of two tuples)."""
        return Vec3(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: "Vec3") -> "Vec3":
        """Difference of two vectors."""
        return Vec3(self.x - other.x, self.y - other.y, self.z - other.z)

    def __neg__(self) -> "Vec3":
        """The opposite vector."""
        return Vec3(-self.x, -self.y, -self.z)

    def __mul__(self, scale: Real) -> "Vec3":  # type: ignore[override]
        """The vector times a number."""
        return Vec3(self.x * scale, self.y * scale, self.z * scale)

    def dot(self, other: "Vec3") -> Real:
        """Scalar product."""
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: "Vec3") -> "Vec3":
        """Vector product."""
        return Vec3(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )


def vec3(triple: Triple) -> Vec3:
    """The vector held in an array of three."""
    return Vec3(triple[0], triple[1], triple[2])


def module_of(*values: object) -> Any:
    """NumPy, or JAX's twin of it if any of the values is JAX's.

    What no derivative is wanted of is laid out by NumPy: JAX would compile a program for it.
    """
    return jnp if any(isinstance(value, jax.Array) for value in values) else np


def choose(condition: Array | bool, a: Any, b: Any) -> Any:
    """`a` where the condition holds, else `b`, leaf by leaf; known conditions cost nothing."""
    if isinstance(condition, bool):
        return a if condition else b

    def either(p: Array, q: Array) -> Any:
        if module_of(condition, p, q) is np:
            return np.where(condition, p, q)
        alike = jnp.shape(condition) == jnp.shape(p) == jnp.shape(q)
        if alike and jnp.result_type(p) == jnp.result_type(q):
            return jax.lax.select(condition, p, q)  # a tenth of the time to trace
        return jnp.where(condition, p, q)

    return jax.tree.map(either, a, b)


def least_square(like: Real) -> float:
    """Squared cosines below this count as zero: 1e-10 in float32, 1e-20 in float64, as `like` is.

    A root has an infinite slope at zero, and second derivatives grow as its cube; this far from
    zero they stay within the range of the type, and what is cut off is seen by no pixel.
    """
    return 1e-20 if jnp.result_type(like) == jnp.float64 else 1e-10


@jax.custom_jvp
def inverse(x: Real) -> Real:
    """1/x, with derivatives of any order that divide no more.

    JAX's own divide twice for each quotient and order; a division takes as long as ten products.
    """
    return 1.0 / x


@inverse.defjvp
def _inverse_jvp(primals: tuple[Real], tangents: tuple[Real]) -> tuple[Real, Real]:
    value = inverse(*primals)
    return value, tangents[0] * (-value * value)


@jax.custom_jvp
def root(x: Real) -> Real:
    """√x, with derivatives of any order that divide once, all of them together."""
    return jnp.sqrt(x)


@root.defjvp
def _root_jvp(primals: tuple[Real], tangents: tuple[Real]) -> tuple[Real, Real]:
    value = root(*primals)
    return value, tangents[0] * (0.5 * inverse(value))


def safe_sqrt(x: Real, above: Real | float = 0.0) -> Real:
    """`sqrt(x)` where `x > above`, which is ≥ 0; elsewhere 0, with zero gradient."""
    positive = x > above
    return jnp.where(positive, root(jnp.where(positive, x, 1.0)), 0.0)


@jax.custom_jvp
def inverse_root(x: Real) -> Real:
    """1/√x, with derivatives of any order that neither divide nor take roots."""
    return jnp.sqrt(1.0 / x)


@inverse_root.defjvp
def _inverse_root_jvp(primals: tuple[Real], tangents: tuple[Real]) -> tuple[Real, Real]:
    value = inverse_root(*primals)
    return value, tangents[0] * (-0.5 * value * (value * value))


def normalize(v: Vec3) -> Vec3:
    """The unit vector along `v`; NaN for the zero vector, which has none."""
    squared = v.dot(v)
    if module_of(squared) is np:
        return v * np.sqrt(1.0 / squared)
    return v * inverse_root(squared)
