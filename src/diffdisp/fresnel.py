"""Reflection and refraction at a smooth surface, unpolarised light."""

import jax.numpy as jnp

from diffdisp.vector import Real, Vec3, least_square, safe_sqrt


def reflect(direction: Vec3, normal: Vec3, cos_i: Real) -> Vec3:
    """Mirror direction.

    Args:
        direction: unit vector of the incoming ray.
        normal: unit vector against it, so that `cos_i` = -direction·normal ≥ 0.
        cos_i: cosine of the angle of incidence.
    """
    return direction + normal * (2.0 * cos_i)


def cos_transmitted(cos_i: Real, eta: Real) -> Real:
    """Cos θₜ = √(η² - 1 + cos²θᵢ) / η; 0, with zero gradient, under total internal reflection.

    The usual √(1 - sin²θᵢ/η²) loses 1.7e-4 at grazing incidence in float32.

    Args:
        cos_i: cosine of the angle of incidence, ≥ 0.
        eta: index behind the surface over index before it.
    """
    # (η - 1)(η + 1) keeps what η² - 1 would cancel where the two media are nearly the same.
    return safe_sqrt((eta - 1.0) * (eta + 1.0) + cos_i * cos_i, least_square(cos_i)) / eta


def refract(direction: Vec3, normal: Vec3, cos_i: Real, cos_t: Real, eta: Real) -> Vec3:
    """Refracted unit direction (Snell); meaningless under total internal reflection.

    Args:
        direction: unit vector of the incoming ray.
        normal: unit vector against it.
        cos_i: cosine of the angle of incidence, ≥ 0.
        cos_t: `cos_transmitted(cos_i, eta)`.
        eta: index behind the surface over index before it.
    """
    return direction * (1.0 / eta) + normal * (cos_i / eta - cos_t)


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
    s = (cos_i - eta * cos_t) / jnp.where(total, 1.0, cos_i + eta * cos_t)
    p = (eta * cos_i - cos_t) / jnp.where(total, 1.0, eta * cos_i + cos_t)
    return jnp.where(total, 1.0, 0.5 * (s * s + p * p))
