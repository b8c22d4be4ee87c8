"""A fit's result without a fit, and what to expect of one without a render."""

from dataclasses import fields, replace

import numpy as np

from diffdisp.camera import Camera
from diffdisp.fitting import FitResult, Uncertainty
from diffdisp.geometry import Sphere
from diffdisp.glasses import glass_table, named_glass
from diffdisp.image import Picture
from diffdisp.material import Dielectric
from diffdisp.scene import Object, Scene

BANDS = np.linspace(0.41, 0.69, 16)


def blurred_ring(size: int, channels: int) -> np.ndarray:
    """Something to look at: a ring in a gradient, (size, size, channels)."""
    y, x = np.mgrid[-1 : 1 : size * 1j, -1 : 1 : size * 1j]
    ring = np.exp(-(((np.hypot(x, y) - 0.6) / 0.15) ** 2)) * (1 + 0.4 * np.sin(6 * x))
    tint = np.linspace(0.7, 1.2, channels)
    return 0.1 + 0.2 * (x + 1)[..., None] * tint + ring[..., None] * tint[::-1]


def fake_target(wavelengths: np.ndarray | None = BANDS, size: int = 32) -> Picture:
    """The ring with noise."""
    channels = 3 if wavelengths is None else len(wavelengths)
    clean = blurred_ring(size, channels)
    noise = np.random.default_rng(0).normal(0, 1e-3, clean.shape)
    return Picture((clean + noise).astype(np.float32), wavelengths)


def fake_result(wavelengths: np.ndarray = BANDS, channels: int = 16, **changes) -> FitResult:
    """N-BK7 all but found, as from visible light: n is known, B and C are not."""
    glass = named_glass("N-BK7")
    B, C = np.asarray(glass.B) * (1 + 1e-5), np.asarray(glass.C)
    n = np.asarray(glass.indices(wavelengths)) + 5e-6
    std = np.array([0.9, 0.95, 1.7, 0.005, 0.04, 140.0])
    nearest = sorted(
        (float(abs(other.n_d - n[len(n) // 2]) / 5e-6), name)
        for name, other in glass_table().items()
    )
    result = FitResult(
        scene=Scene(
            Camera([0, 0, 4], [0, 0, 0]), [Object(Sphere([0, 0, 0], 1), Dielectric(glass))]
        ),
        glass=glass,
        object_name="ball",
        converged=True,
        message="a minimum that explains the picture",
        steps=7,
        B=B,
        C=C,
        B_std=std[:3],
        C_std=std[3:],
        covariance=np.diag(std**2),
        n_d=1.5168049,
        n_d_std=3.2e-6,
        V_d=64.171,
        V_d_std=0.021,
        P_gF=0.53491,
        P_gF_std=4.1e-4,
        wavelengths=wavelengths,
        n=n,
        n_std=5e-6 * (1 + 20 * (wavelengths - wavelengths.mean()) ** 2),
        singular_values=np.array([2e5, 3e3, 80.0, 0.6, 1e-2, 1e-4]),
        determined=3,
        summary=(
            "The picture determines n(λ) to 6e-6 and 3 of 6 directions of log B, log C; B and C "
            "one by one are not determined by light of 410-690 nm alone."
        ),
        rms_residual=1.03e-3,
        nearest_glasses=tuple((name, distance) for distance, name in nearest[:5]),
        prior="none",
        noise=None,
        samples=(16, 144),
        picture=blurred_ring(32, channels),
    )
    return replace(result, **changes)


def fake_expected(**changes) -> Uncertainty:
    """What to expect, as of the fake fit."""
    result = fake_result(noise=1e-3, **changes)
    return Uncertainty(**{each.name: getattr(result, each.name) for each in fields(Uncertainty)})
