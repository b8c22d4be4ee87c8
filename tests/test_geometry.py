import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import numbers

from diffdisp.geometry import (
    Ray,
    fine_first_distance,
    first_distance,
    mean_root,
    plane_axes,
    plane_distance,
    sphere_depth,
    sphere_distances,
)
from diffdisp.vector import Vec3, normalize, vec3

RNG = np.random.default_rng(1)
FIRST = RNG.bit_generator.state


@pytest.fixture(autouse=True)
def same_numbers():
    """Every test begins with the same random numbers, whichever ran before it."""
    RNG.bit_generator.state = FIRST


BESIDE = Vec3(*jnp.array([0.0, 0.0, -5.0]))


def ray(origin, direction):
    """A ray of arrays, whose direction is made a unit vector."""
    direction = np.asarray(direction, float)
    return Ray(vec3(jnp.asarray(origin, float)), vec3(jnp.asarray(unit(direction))))


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def meet(origins, directions, center, radius):
    """`sphere_distances` of many rays (N, 3), in the dtype of the arrays."""
    rays = Ray(Vec3(*jnp.asarray(origins).T), Vec3(*jnp.asarray(directions).T))
    one = jax.vmap(lambda r: sphere_distances(r, vec3(jnp.asarray(center)), jnp.asarray(radius)))
    return [np.asarray(part) for part in jax.jit(one)(rays)]


def truth(origins, directions, center, radius):
    """Roots of |o + t d - c|² = r² by `np.roots`' textbook form, in float64."""
    origins, directions, center = (np.asarray(v, np.float64) for v in (origins, directions, center))
    o = origins - center
    a, b = (directions**2).sum(-1), (o * directions).sum(-1)
    # Lagrange's identity: a·|o|² - (o·d)² = |o × d|², without cancellation.
    discriminant = a * np.float64(radius) ** 2 - (np.cross(o, directions) ** 2).sum(-1)
    root = np.sqrt(np.maximum(discriminant, 0))
    return (-b - root) / a, (-b + root) / a, discriminant > 0


@pytest.mark.parametrize("radius", [1e-3, 1.0, 100.0])
@pytest.mark.parametrize("scale", [0.3, 2.0, 30.0], ids=["inside", "near", "far"])
def test_distances_are_the_roots_of_the_quadratic(radius, scale):
    center = RNG.normal(size=3)
    origins = center + radius * scale * unit(RNG.normal(size=(500, 3)))
    targets = center + radius * RNG.uniform(-1.2, 1.2, size=(500, 3))
    directions = unit(targets - origins)
    near, far, hit = meet(origins, directions, center, radius)
    t1, t2, expected = truth(origins, directions, center, radius)
    np.testing.assert_array_equal(hit, expected)
    # Rounding at the distance `scale`, over the root's slope at the most grazing of 500 rays.
    tolerance = 1e-13 * radius * (1 + scale) ** 2
    np.testing.assert_allclose(near[hit], t1[hit], rtol=0, atol=tolerance)
    np.testing.assert_allclose(far[hit], t2[hit], rtol=0, atol=tolerance)


def test_a_far_small_ball_keeps_its_outline_in_float32():
    # The unit ball at distance 1e4; a quadratic in float32 misjudges a fifth of these rays.
    distance = np.float32(1e4)
    impact, turn = RNG.uniform(0, 2, 2000), RNG.uniform(0, 2 * np.pi, 2000)
    targets = np.stack([impact * np.cos(turn), impact * np.sin(turn), 0 * impact], -1)
    origins = np.zeros((2000, 3), np.float32) + np.float32([0, 0, distance])
    directions = unit(targets - origins).astype(np.float32)
    with jax.enable_x64(False):
        near, far, hit = meet(origins, directions, np.zeros(3, np.float32), np.float32(1))
    t1, t2, expected = truth(origins, unit(directions.astype(float)), np.zeros(3), 1.0)
    # A direction's rounding moves the ray by 6e-8 · 1e4, its foot as much again: the rim.
    clear = np.abs(impact - 1) > 2e-3
    np.testing.assert_array_equal(hit[clear], expected[clear])
    sure = clear & expected
    # Half a unit in the last place of 1e4 for the result and each of two operations before it,
    # and what the foot's error does to the root at the rim, 0.0013 · 1 / √(1 - 0.998²).
    np.testing.assert_allclose(near[sure], t1[sure], rtol=0, atol=0.03)
    np.testing.assert_allclose(far[sure], t2[sure], rtol=0, atol=0.03)


@pytest.mark.parametrize(
    ("origin", "direction", "near", "far"),
    [
        ((0, 0, 3), (0, 0, -1), 2, 4),
        ((0, 0, 3), (0, 0, 1), -4, -2),
        ((0, 0, 0), (0, 1, 0), -1, 1),
        ((0, 0, 1), (0, 0, 1), -2, 0),
        ((0, 0, 1), (0, 0, -1), 0, 2),
        ((0, 0, 1), (0.6, 0, -0.8), 0, 1.6),
    ],
)
def test_distances_from_before_behind_within_and_on_the_sphere(origin, direction, near, far):
    found = sphere_distances(ray(origin, direction), vec3(jnp.zeros(3)), jnp.array(1.0))
    np.testing.assert_allclose(found[:2], (near, far), rtol=0, atol=1e-15)
    assert found[2]


def ends(x, z=3.0, radius=1.0):
    """Both distances for a ray along -z beside the axis."""
    start = Ray(Vec3(x, jnp.zeros(()), jnp.asarray(z)), vec3(jnp.array([0, 0, -1.0])))
    return jnp.stack(sphere_distances(start, vec3(jnp.zeros(3)), jnp.asarray(radius))[:2])


FORWARD = jax.jit(jax.jacfwd(ends, argnums=(0, 1, 2)))
REVERSE = jax.jit(jax.jacrev(ends, argnums=(0, 1, 2)))
SECOND = jax.jit(jax.jacfwd(jax.jacrev(ends)))


@pytest.mark.parametrize("x", [0.0, 0.5, np.nextafter(1, 0), 1.0, np.nextafter(1, 2), 2.0])
@pytest.mark.parametrize("z", [3.0, 0.0, -3.0])
@pytest.mark.parametrize("mode", [FORWARD, REVERSE, SECOND])
def test_gradients_are_finite_at_the_rim_and_beyond(x, z, mode):
    slopes = mode(jnp.array(x), jnp.array(z), jnp.array(1.0))
    assert all(np.isfinite(slope).all() for slope in jax.tree.leaves(slopes))


@pytest.mark.parametrize("x", [0.0, 0.6, 0.8])
def test_gradients_by_hand(x):
    by_x, _, by_radius = FORWARD(jnp.array(x), jnp.array(3.0), jnp.array(1.0))
    root = np.sqrt(1 - x * x)
    np.testing.assert_allclose(
        by_x, [x / root, -x / root], rtol=0, atol=1e-14
    )  # some ten roundings
    np.testing.assert_allclose(by_radius, [-1 / root, 1 / root], rtol=0, atol=1e-14)


# --- the first point ahead


def first(origins, directions, center, radius, on=False):
    """`first_distance` of many rays (N, 3), in the dtype of the arrays."""
    rays = Ray(Vec3(*jnp.asarray(origins).T), Vec3(*jnp.asarray(directions).T))
    sphere = vec3(jnp.asarray(center)), jnp.square(jnp.asarray(radius))
    one = jax.vmap(lambda r: first_distance(r, *sphere, jnp.asarray(on)))
    return [np.asarray(part) for part in jax.jit(one)(rays)]


@pytest.mark.parametrize(
    ("origin", "direction", "on", "distance"),
    [
        ((0, 0, 3), (0, 0, -1), False, 2),
        ((0, 0.6, 3), (0, 0, -1), False, 2.2),
        ((0, 0, 0.5), (0, 0, -1), False, 1.5),  # inside
        ((0, 0, 0.5), (0, 0, 1), False, 0.5),
        ((0, 0, 0), (0.6, 0.8, 0), False, 1),
        ((0, 0, 1), (0, 0, -1), True, 2),  # on it, inwards: a chord
        ((0, 0, 1), (0.6, 0, -0.8), True, 1.6),
        ((0, 0, 1 + 1e-14), (0, 0, -1), False, 2),  # rounding away from it is on it
        ((0, 0, 1 - 1e-14), (0, 0, -1), False, 2),
        ((0, np.nextafter(1, 0), 3), (0, 0, -1), False, 3),  # next to a tangent
    ],
)
def test_first_point_of_a_sphere(origin, direction, on, distance):
    start = np.array([origin], float), np.array([direction], float)
    found, meets = first(*start, np.zeros(3), 1.0, on)
    assert meets
    # Rounding; of the height 1e-14 it is half a turn's length, and next to the tangent its root.
    np.testing.assert_allclose(found, distance, rtol=0, atol=3e-8 if distance == 3 else 2e-14)


@pytest.mark.parametrize(
    ("origin", "direction", "on"),
    [
        ((0, 2, 3), (0, 0, -1), False),  # beside it
        ((0, 1, 3), (0, 0, -1), False),  # a tangent
        ((0, 0, 3), (0, 0, 1), False),  # behind
        ((0, 0.6, 3), (0, 0, 1), False),
        ((0, 0, 1), (0, 0, 1), True),  # on it, outwards
        ((0, 0, 1), (0.6, 0, 0.8), True),
        ((0, 0, 1), (1, 0, 0), True),  # along it
        ((0, 0, 1 + 1e-14), (0.6, 0, 0.8), False),
        ((0, 0, 1 - 1e-14), (0.6, 0, 0.8), False),
    ],
)
def test_no_point_of_a_sphere_ahead(origin, direction, on):
    start = np.array([origin], float), np.array([direction], float)
    assert not first(*start, np.zeros(3), 1.0, on)[1]


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("radius", [0.3, 1.0, 100.0])
@pytest.mark.parametrize("on", [False, True])
def test_no_ray_meets_the_point_that_it_leaves(on, radius, dtype):
    # Rounded points of a sphere; whether it is known that they are, or not.
    rng = np.random.default_rng(2)
    center = rng.normal(size=3).astype(dtype)
    up, aside = unit(rng.normal(size=(2, 500, 3)))
    aside = unit(aside - up * (aside * up).sum(-1, keepdims=True))
    cosine = rng.uniform(0.01, 1.0, (500, 1))
    origins = (center + radius * up).astype(dtype)
    with jax.enable_x64(dtype == "float64"):
        for side in (1, -1):
            directions = (aside * np.sqrt(1 - cosine**2) + side * up * cosine).astype(dtype)
            sphere = center, np.asarray(radius, dtype)
            found, meets = first(origins, directions, *sphere, on)
            assert meets.all() == (side < 0)
            assert meets.any() == (side < 0)
    # A chord: some ten roundings of terms of the second degree, over r cos.
    error = np.abs(found - 2 * radius * cosine[:, 0]) * cosine[:, 0]
    assert error.max() < 10 * (radius + np.abs(center).max()) * np.finfo(dtype).eps


@pytest.mark.parametrize("scale", [0.3, 0.99, 2.0, 30.0])
def test_first_point_is_the_least_positive_root(scale):
    origins = scale * unit(RNG.normal(size=(500, 3)))
    directions = unit(RNG.uniform(-1.2, 1.2, size=(500, 3)) - origins)
    found, meets = first(origins, directions, np.zeros(3), 1.0)
    near, far, hit = truth(origins, directions, np.zeros(3), 1.0)
    expected = np.where(near > 0, near, far)
    np.testing.assert_array_equal(meets, hit & (expected > 0))
    # As of both distances.
    np.testing.assert_allclose(found[meets], expected[meets], rtol=0, atol=1e-13 * (1 + scale) ** 2)


EPS = 2.0**-24
"""Largest relative rounding error of float32."""


@pytest.mark.parametrize("within", [False, True])
def test_first_point_of_a_large_sphere_in_float32(within):
    # From 1 above or below the surface of a sphere of radius 1e4, towards it.
    radius = 1e4
    up = unit(RNG.normal(size=(2000, 3)))
    origins = ((radius + (-1.0 if within else 1.0)) * up).astype(np.float32)
    directions = unit(RNG.normal(size=(2000, 3)))
    directions -= up * (directions * up).sum(-1, keepdims=True)
    cosine = RNG.uniform(0.1, 1.0, (2000, 1))
    directions = unit(directions) * np.sqrt(1 - cosine**2) - up * cosine * (-1 if within else 1)
    directions = directions.astype(np.float32)
    with jax.enable_x64(False):
        found, meets = first(origins, directions, np.zeros(3, np.float32), np.float32(radius))
    assert found.dtype == np.float32
    near, far, _ = truth(origins, unit(directions.astype(float)), np.zeros(3), radius)
    assert meets.all()
    # Some five roundings of o² - r², of 1e8 each; over the divisor, 2 r cos.
    error = np.abs(found - (far if within else near)) * 2 * radius * cosine[:, 0]
    assert error.max() < 5 * EPS * radius**2


def test_first_point_of_a_far_small_sphere_in_float32():
    # The unit ball at distance 1e4, by a million rays as float32 holds them.
    count = 1_000_000
    impact, turn = RNG.uniform(0, 2, count), RNG.uniform(0, 2 * np.pi, count)
    targets = np.stack([impact * np.cos(turn), impact * np.sin(turn), 0 * impact], -1)
    origins = np.zeros((count, 3), np.float32) + np.float32([0, 0, 1e4])
    directions = unit(targets - origins).astype(np.float32)
    with jax.enable_x64(False):
        found, meets = first(origins, directions, np.zeros(3, np.float32), np.float32(1))
    along = directions.astype(float)
    near, _, hit = truth(origins, along, np.zeros(3), 1.0)
    passed = np.linalg.norm(np.cross(origins, along), axis=-1) / np.linalg.norm(along, axis=-1)
    clear = np.abs(passed - 1) > 1e-4
    np.testing.assert_array_equal(meets[clear], hit[clear])
    sure = clear & hit
    np.testing.assert_allclose(found[sure], near[sure], rtol=4e-7)


def fine(origins, directions, center, radius, on=False):
    """`fine_first_distance` of many rays (N, 3), in float32."""
    with jax.enable_x64(False):
        origins, directions, center, radius = (
            jnp.asarray(v, jnp.float32) for v in (origins, directions, center, radius)
        )
        rays = Ray(Vec3(*origins.T), Vec3(*directions.T))
        one = jax.vmap(lambda r: fine_first_distance(r, vec3(center), radius, jnp.asarray(on)))
        return [np.asarray(part) for part in jax.jit(one)(rays)]


@pytest.mark.parametrize("radius", [1.0, 1e3, 1e5, 1e6])
def test_fine_distance_to_a_ground_however_large(radius):
    # A million rays from about 1 above it, down to a cosine of 0.01.
    count = 1_000_000
    turn, cosine = RNG.uniform(0, 2 * np.pi, count), RNG.uniform(0.01, 1, count)
    sine = np.sqrt(1 - cosine**2)
    directions = np.stack([np.cos(turn) * sine, -cosine, np.sin(turn) * sine], -1)
    directions = directions.astype(np.float32)
    origins = (RNG.uniform(-0.3, 0.3, (count, 3)) + np.array([0, 1, 0])).astype(np.float32)
    center = np.array([0, -radius, 0])
    found, meets = fine(origins, directions, center, radius)
    near, _, hit = truth(origins, directions, center, radius)
    passed = np.linalg.norm(np.cross(origins - center, directions.astype(float)), axis=-1)
    clear = np.abs(passed / radius - 1) > 1e-4
    np.testing.assert_array_equal(meets[clear], hit[clear])
    sure = meets & hit & clear
    assert sure.sum() > count / 10
    np.testing.assert_allclose(found[sure], near[sure], rtol=1e-5)


@pytest.mark.parametrize("scale", [0.3, 0.99, 1.01, 2.0, 30.0, 1e4])
def test_fine_distance_is_the_least_positive_root(scale):
    center = np.array([0.3, -0.2, 0.1])
    origins = (center + scale * unit(RNG.normal(size=(5000, 3)))).astype(np.float32)
    targets = center + RNG.uniform(-1.2, 1.2, size=(5000, 3))
    directions = unit(targets - origins).astype(np.float32)
    found, meets = fine(origins, directions, center.astype(np.float32), 1.0)
    near, far, hit = truth(origins, directions, center.astype(np.float32), 1.0)
    expected = np.where(near > 0, near, far)
    passed = np.linalg.norm(
        np.cross(origins - center.astype(np.float32), directions.astype(float)), axis=-1
    )
    clear = np.abs(passed - 1) > 1e-3
    np.testing.assert_array_equal(meets[clear], (hit & (expected > 0))[clear])
    sure = clear & meets
    np.testing.assert_allclose(found[sure], expected[sure], rtol=1e-5)


def test_fine_distance_from_a_sphere_is_its_chord():
    out, inward = unit(RNG.normal(size=(500, 3))), unit(RNG.normal(size=(500, 3)))
    inward = np.where((inward * out).sum(-1, keepdims=True) < 0, inward, -inward)
    chord = -2 * 1e5 * (inward * out).sum(-1)
    found, meets = fine(1e5 * out, inward, np.zeros(3), 1e5, on=True)
    assert meets.all()
    np.testing.assert_allclose(found, chord, rtol=1e-4, atol=1.0)
    _, meets = fine(1e5 * out, -inward, np.zeros(3), 1e5, on=True)
    assert not meets.any()


def test_derivatives_of_a_fine_distance():
    center, radius = vec3(jnp.array([0.2, 0.1, -0.3], jnp.float32)), jnp.float32(0.8)
    start = Ray(
        vec3(jnp.array([0.1, 0.3, 3.0], jnp.float32)), vec3(jnp.array([0, 0, -1], jnp.float32))
    )
    on = jnp.asarray(False)
    of = start, center, radius
    change = jax.tree.map(lambda leaf: leaf * 0 + jnp.float32(0.3), of)
    _, slope = jax.jvp(lambda ray, c, r: fine_first_distance(ray, c, r, on)[0], of, change)
    _, expected = jax.jvp(lambda ray, c, r: first_distance(ray, c, r * r, on)[0], of, change)
    np.testing.assert_allclose(slope, expected, rtol=1e-5)


def first_of(x, z, radius, on):
    """The distance for a ray along -z beside the axis."""
    start = Ray(Vec3(x, jnp.zeros(()), z), vec3(jnp.array([0, 0, -1.0])))
    return first_distance(start, vec3(jnp.zeros(3)), radius * radius, on)[0]


FIRST_FORWARD = jax.jit(jax.jacfwd(first_of, argnums=(0, 1, 2)))
FIRST_REVERSE = jax.jit(jax.jacrev(first_of, argnums=(0, 1, 2)))
FIRST_SECOND = jax.jit(jax.jacfwd(jax.jacrev(first_of)))


@pytest.mark.parametrize("x", [0.0, 0.5, np.nextafter(1, 0), 1.0, np.nextafter(1, 2), 2.0])
@pytest.mark.parametrize("z", [3.0, 0.5, 0.0, -3.0])
@pytest.mark.parametrize("mode", [FIRST_FORWARD, FIRST_REVERSE, FIRST_SECOND])
@pytest.mark.parametrize("on", [False, True])
def test_gradients_of_the_first_point_are_finite(x, z, mode, on):
    slopes = mode(jnp.array(x), jnp.array(z), jnp.array(1.0), jnp.array(on))
    assert all(np.isfinite(slope).all() for slope in jax.tree.leaves(slopes))


@pytest.mark.parametrize(("z", "sign"), [(3.0, -1), (0.2, 1)])
@pytest.mark.parametrize("x", [0.0, 0.6, 0.8])
def test_gradients_of_the_first_point_by_hand(x, z, sign):
    # z - √(1 - x²) from outside, z + √(1 - x²) from inside.
    by_x, by_z, by_radius = FIRST_FORWARD(
        jnp.array(x), jnp.array(z), jnp.array(1.0), jnp.array(False)
    )
    root = np.sqrt(1 - x * x)
    expected = [-sign * x / root, 1, sign / root]
    np.testing.assert_allclose(
        [by_x, by_z, by_radius], expected, rtol=0, atol=1e-14
    )  # some ten roundings


# --- planes


@pytest.mark.parametrize(
    ("origin", "direction", "normal", "distance"),
    [
        ((0, 0, 0), (0, 0, -1), (0, 0, 1), 5),
        ((0, 0, 0), (0, 0, -1), (0, 0, -7), 5),
        ((0, 0, -9), (0, 0, 1), (0, 0, 1), 4),
        ((0, 0, 0), (0, 0, 1), (0, 0, 1), -5),
        ((0, 0, 0), (0.6, 0, -0.8), (0, 0, 1), 6.25),
        ((0, 0, 0), (1, 0, 0), (0, 0, 1), -1),
        ((0, 0, -5), (1, 0, 0), (0, 0, 1), -1),
    ],
)
def test_distance_to_a_plane(origin, direction, normal, distance):
    found = plane_distance(ray(origin, direction), BESIDE, vec3(jnp.asarray(normal, float)))
    np.testing.assert_allclose(found, distance, rtol=1e-15)


def test_gradient_is_finite_along_a_plane():
    def distance(direction):
        start = Ray(vec3(jnp.zeros(3)), vec3(direction))
        return plane_distance(start, BESIDE, vec3(jnp.array([0, 0, 1.0])))

    assert np.isfinite(jax.grad(distance)(jnp.array([1.0, 0, 0]))).all()


@pytest.mark.parametrize(
    ("normal", "u", "v"),
    [
        ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
        ((0, 0, -2), (-1, 0, 0), (0, 1, 0)),
        ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
        ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
        ((0, -3, 0), (1, 0, 0), (0, 0, 1)),
    ],
)
def test_axes_of_the_main_planes(normal, u, v):
    axes = plane_axes(vec3(jnp.asarray(normal, float)))
    np.testing.assert_array_equal(numbers(axes[0]), u)
    np.testing.assert_array_equal(numbers(axes[1]), v)


@pytest.mark.parametrize("normal", [*RNG.normal(size=(4, 3)), np.array([1e-9, 1.0, 0.0])])
def test_axes_as_defined(normal):
    u, v = (numbers(axis) for axis in plane_axes(vec3(jnp.asarray(normal))))
    # Unit vectors, rounded a few times.
    np.testing.assert_allclose(u, unit(np.cross([0, 1, 0], normal)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(v, np.cross(unit(normal), u), rtol=0, atol=1e-15)
    np.testing.assert_allclose([np.linalg.norm(v), u @ v], [1, 0], rtol=0, atol=1e-15)


@pytest.mark.parametrize("normal", [(0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.3, -0.5, 0.2)])
def test_gradients_of_the_axes_are_finite(normal):
    slopes = jax.jacrev(lambda n: plane_axes(vec3(n)))(jnp.array(normal))
    assert all(np.isfinite(slope).all() for slope in jax.tree.leaves(slopes))


@pytest.mark.parametrize("width", [1e-6, 0.01, 0.3])
def test_mean_root_is_that_of_a_box(width):
    middle = width * np.linspace(-0.49, 3, 50)
    points = middle[:, None] + width * ((np.arange(4000) + 0.5) / 4000 - 0.5)
    expected = np.sqrt(np.maximum(points, 0)).mean(axis=1)
    found = jax.vmap(mean_root, (0, None))(middle, jnp.asarray(width))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * np.sqrt(width))  # of the sum
    slope = jax.vmap(jax.grad(mean_root), (0, None))(middle, jnp.asarray(width))
    assert np.isfinite(slope).all()


def test_depth_of_a_line_in_a_sphere_and_its_changes():
    center, radius = vec3(jnp.array([0.1, -0.2, 0.3])), jnp.array(0.7)
    there = Ray(vec3(jnp.array([2.0, 0.3, 0.1])), normalize(vec3(jnp.array([-1.0, -0.2, 0.2]))))
    still = vec3(jnp.zeros(3))
    # A direction's change is at right angles to it.
    turn = there.direction.cross(vec3(jnp.array([0.0, 0.0, 0.01])))
    footprint = Ray(vec3(jnp.array([0.01, 0.02, 0])), still), Ray(still, turn)
    along, depth, edges = sphere_depth(there, footprint, center, radius)

    def exact(ray):
        """From the area of the parallelogram that spans the distance to the line."""
        across = (ray.origin - center).cross(ray.direction)
        return 1 - across.dot(across) / ray.direction.dot(ray.direction) / radius**2

    np.testing.assert_allclose(depth, exact(there), rtol=1e-14)
    np.testing.assert_allclose(along, (center - there.origin).dot(there.direction), rtol=1e-14)
    for edge, found in zip(footprint, edges, strict=True):
        _, expected = jax.jvp(exact, (there,), (edge,))
        np.testing.assert_allclose(found, expected, rtol=1e-12)
