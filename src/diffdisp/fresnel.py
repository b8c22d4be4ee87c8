"""Reflection and refraction at a smooth surface, unpolarised light."""

import jax.numpy as jnp

from diffdisp.vector import Real, inverse, least_square, safe_sqrt


def reflection(cos_i: Real) -> tuple[Real, Real]:
    """What the mirror direction is made of: so much of the old one, and of the normal.

    Args:
        cos_i: cosine of the angle of incidence, ≥ 0; the normal is a unit vector on the side that
            the ray comes from.
    """
    return jnp.ones_like(cos_i), 2.0 * cos_i


def cos_transmitted(cos_i: Real, eta: Real) -> Real:
    """Cos θₜ = √(η² - 1 + cos²θᵢ) / η; 0, with zero gradient, under total internal reflection.

    The usual √(1 - sin²θᵢ/η²) loses 1.7e-4 at grazing incidence in float32.

    Args:
        cos_i: cosine of the angle of incidence, ≥ 0.
        eta: index behind the surface over index before it.
    """
    # (η - 1)(η + 1) keeps what η² - 1 would cancel where the two media are nearly the same.
    root = safe_sqrt((eta - 1.0) * (eta + 1.0) + cos_i * cos_i, least_square(cos_i))
    return root * inverse(eta)


def refraction(cos_i: Real, cos_t: Real, eta: Real) -> tuple[Real, Real]:
    """The same of the refracted direction (Snell); meaningless under total internal reflection.

    Args:
        cos_i: as in `reflection`.
        cos_t: `cos_transmitted(cos_i, eta)`.
        eta: index behind the surface over index before it.
    """
    slower = inverse(eta)
    return slower, cos_i * slower - cos_t


def fresnel_reflectance(cos_i: Real, cos_t: Real, eta: Real) -> Real:
    """Reflectance for unpolarised light, exact.

    Args:
        cos_i: cosine of the angle of incidence, ≥ 0.
        cos_t: `cos_transmitted(cos_i, eta)`; 0 means total internal reflection.
        eta: index behind the surface over index before it.

    Returns:
        R within [0, 1]; 1 under total internal reflection.

    Source:
        Born and Wolf, Principles of Optics (7th ed.), section 1.5.2, eqs. 21a and 32.
    """
    # Both denominators vanish together only where cos_i = cos_t = 0: the guard keeps the
    # quotient finite there, and R = 1 is then chosen.
    total = cos_t <= 0
    s = (cos_i - eta * cos_t) * inverse(jnp.where(total, 1.0, cos_i + eta * cos_t))
    p = (eta * cos_i - cos_t) * inverse(jnp.where(total, 1.0, eta * cos_i + cos_t))
    return jnp.where(total, 1.0, 0.5 * (s * s + p * p))
