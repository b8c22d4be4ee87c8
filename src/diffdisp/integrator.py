"""The tracer: one path, one surface at a time.

At a glass surface a path has two continuations: the *outer* ray leaves the ball that was met,
the *inner* ray stays in it or enters it; one is the reflected and the other the refracted one.
A continuation that next meets a lamp, a screen or the background ends there: its light is added
at once, exactly. Of two that meet glass again one is chosen. So the orders of one ball are
summed without noise, and only several balls cost any.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero, zero_from_primal
from jaxtyping import Float, Int

from diffdisp.camera import Camera, camera_ray
from diffdisp.fresnel import cos_transmitted, fresnel_reflectance, reflect, refract
from diffdisp.geometry import Plane, Ray, Sphere, plane_axes, plane_distance, sphere_distances
from diffdisp.material import Emitter
from diffdisp.planning import Plan
from diffdisp.sampling import low_discrepancy, sequence_steps
from diffdisp.scene import Object, Scene, is_glass
from diffdisp.texture import Checker2D, Solid, filtered_square_wave
from diffdisp.vector import Array, Real, Triple, Vec3, choose, normalize, vec3


class World(NamedTuple):
    """The geometry of a scene as tables: balls first, then lamps, then planes.

    A surface's number is its row in that order; one past the last is the background.
    """

    centers: Vec3
    radii: Float[Array, " spheres"]
    points: Vec3
    normals: Vec3
    axes: tuple[Vec3, Vec3]
    tiles: Float[Array, " planes"]


class Emission(NamedTuple):
    """What the surfaces that end a path emit: lamps, planes, background, a row each.

    A checker shows `mean` + m · `half` where m is +1 on its even tiles and -1 on its odd ones.
    """

    mean: Float[Array, "*lanes surfaces channels"]
    half: Float[Array, "*lanes surfaces channels"]


class Path(NamedTuple):
    """One path on its way to a glass ball."""

    ray: Ray
    footprint: tuple[Ray, Ray]
    ball: Int[Array, ""]
    last: Int[Array, ""]
    throughput: Real
    radiance: Float[Array, " channels"]
    bounces: Int[Array, ""]
    alive: Array


def world_tables(scene: Scene) -> World:
    """The scene's geometry as tables."""
    spheres, planes = _spheres(scene), _planes(scene)
    normals = _table([normalize(vec3(p.normal)) for p, _ in planes])
    return World(
        _table([vec3(s.center) for s, _ in spheres]),
        _row([s.radius for s, _ in spheres]),
        _table([vec3(p.point) for p, _ in planes]),
        normals,
        jax.vmap(plane_axes)(normals),
        _row([_tile(obj, scene) for _, obj in planes]),
    )


def emission_table(scene: Scene) -> Emission:
    """What the scene's emitters and its background emit, linear sRGB in the last axis."""
    colors = [_even_odd(o) for _, o in _spheres(scene) if not is_glass(o)]
    colors += [_even_odd(obj) for _, obj in _planes(scene)]
    colors.append((scene.background.color, scene.background.color))
    even = jnp.stack([jnp.asarray(e) for e, _ in colors])
    odd = jnp.stack([jnp.asarray(o) for _, o in colors])
    return Emission(0.5 * (even + odd), 0.5 * (even - odd))


def _spheres(scene: Scene) -> list[tuple[Sphere, Object]]:
    found = [(o.shape, o) for o in scene.objects if isinstance(o.shape, Sphere)]
    return sorted(found, key=lambda pair: not is_glass(pair[1]))


def _planes(scene: Scene) -> list[tuple[Plane, Object]]:
    return [(obj.shape, obj) for obj in scene.objects if isinstance(obj.shape, Plane)]


def _row(values: list[Real]) -> Float[Array, " rows"]:
    return jnp.stack([jnp.asarray(v) for v in values]) if values else jnp.zeros(0)


def _table(vectors: list[Vec3]) -> Vec3:
    return Vec3(*(_row([v[axis] for v in vectors]) for axis in range(3)))


def _tile(obj: Object, scene: Scene) -> Real:
    texture = obj.material.texture if isinstance(obj.material, Emitter) else None
    one = jnp.ones_like(scene.camera.vertical_fov)
    return texture.tile if isinstance(texture, Checker2D) else one


def _even_odd(obj: Object) -> tuple[Triple, Triple]:
    assert isinstance(obj.material, Emitter)
    texture, intensity = obj.material.texture, obj.material.intensity
    if isinstance(texture, Solid):
        return texture.color * intensity, texture.color * intensity
    return texture.even * intensity, texture.odd * intensity


def _pick(table: Array, index: Array) -> Array:
    """A row of a table; of a table of one row, that row, without a look-up."""
    return table[0] if table.shape[0] == 1 else table[index]


def _pick_vector(table: Vec3, index: Array) -> Vec3:
    return Vec3(*(_pick(component, index) for component in table))


Met = tuple[tuple[Real, Array], None]
"""Distance and number of the nearest surface so far, as a scan hands them on."""


def nearest(ray: Ray, world: World, plan: Plan, last: Array) -> Array:
    """Number of the surface that a ray meets first.

    Args:
        ray: the ray; nothing is differentiated here, a number has no derivative.
        world: the scene's tables.
        plan: its static choices.
        last: number of the sphere on which the ray starts, -1 for none. Its own distance of zero
            is divided out, so that no offset is needed to leave it.
    """
    ray, world = jax.lax.stop_gradient((ray, world))
    spheres, surfaces = plan.balls + plan.lamps, plan.balls + plan.lamps + plan.planes
    best = (jnp.full_like(ray.origin.x, jnp.inf), jnp.full_like(last, surfaces))
    numbers = np.arange(surfaces, dtype=np.int32)

    def meet_sphere(best: tuple[Real, Array], row: tuple[Vec3, Real, Array]) -> Met:
        center, radius, number = row
        to_origin = ray.origin - center
        near, far, hit = sphere_distances(ray, center, radius)
        # Other surfaces may touch the one that the ray leaves: only there a small offset.
        share = 1e-6 if plan.dtype == "float32" else 1e-13
        least = share * (jnp.sqrt(to_origin.dot(to_origin)) + radius)
        first = jnp.where(near > least, near, far)
        distance = jnp.where(number == last, -2.0 * to_origin.dot(ray.direction), first)
        found = jnp.where(number == last, distance > 0, hit & (first > least))
        return _nearer(best, found, distance, number)

    def meet_plane(best: tuple[Real, Array], row: tuple[Vec3, Vec3, Array]) -> Met:
        distance = plane_distance(ray, row[0], row[1])
        return _nearer(best, distance > 0, distance, row[2])

    best = _over(meet_sphere, best, (world.centers, world.radii, numbers[:spheres]), spheres)
    best = _over(meet_plane, best, (world.points, world.normals, numbers[spheres:]), plan.planes)
    return best[1]


def _nearer(best: tuple[Real, Array], found: Array, distance: Real, number: Array) -> Met:
    closer = found & (distance < best[0])
    return (jnp.where(closer, distance, best[0]), jnp.where(closer, number, best[1])), None


def _over(step: Callable[[Any, Any], tuple[Any, None]], start: Any, rows: Any, count: int) -> Any:
    """`step` over the rows of a table, eight to a turn of the loop; few rows make no loop."""
    return jax.lax.scan(step, start, rows, unroll=min(count, 8))[0] if count else start


def push_forward(
    f: Callable[[Ray], tuple[Any, Any]], ray: Ray, footprint: tuple[Ray, Ray]
) -> tuple[Any, Any, Any]:
    """`f(ray)`, its derivatives along both edges of the footprint, and what else `f` found out."""
    value, push, extra = jax.linearize(f, ray, has_aux=True)
    return value, (push(footprint[0]), push(footprint[1])), extra


def emitted(
    surface: Array,
    ray: Ray,
    footprint: tuple[Ray, Ray],
    world: World,
    emission: Emission,
    plan: Plan,
) -> Float[Array, " channels"]:
    """Radiance (channels,) of the surface that ends a ray, averaged over its footprint."""
    row = jnp.maximum(surface - plan.balls, 0)
    mean = _pick(emission.mean, row)
    if not plan.checkered:
        return mean
    plane = surface - plan.balls - plan.lamps
    on_plane = (plane >= 0) & (plane < plan.planes)
    number = jnp.clip(plane, 0, plan.planes - 1)

    def tile_coordinates(ray: Ray) -> tuple[tuple[Real, Real], None]:
        point, normal = _pick_vector(world.points, number), _pick_vector(world.normals, number)
        cosine = jnp.where(on_plane, ray.direction.dot(normal), 1.0)
        distance = (point - ray.origin).dot(normal) / cosine
        offset = ray.origin + ray.direction * distance - point
        scale = 1.0 / _pick(world.tiles, number)
        u, v = (_pick_vector(axis, number) for axis in world.axes)
        return (offset.dot(u) * scale, offset.dot(v) * scale), None

    (u, v), (across, down), _ = push_forward(tile_coordinates, ray, footprint)
    mix = filtered_square_wave(u, across[0], down[0]) * filtered_square_wave(v, across[1], down[1])
    return mean + _pick(emission.half, row) * jnp.where(on_plane, mix, 0.0)


def start_path(
    camera: Camera,
    world: World,
    emission: Emission,
    plan: Plan,
    height: Real,
    film_point: tuple[Real, Real],
    middle: tuple[Real, Real],
    cell: tuple[Real, Real],
) -> Path:
    """The path from a film point to its first surface; ended, unless that one is glass.

    Args:
        camera: the camera.
        world: the scene's tables.
        emission: what ends paths.
        plan: the scene's static choices.
        height: rows of the picture.
        film_point: pixels to the right of and below the picture's upper left corner.
        middle: the picture's middle, in the same pixels.
        cell: width and height of the part of the film that the sample stands for, pixels.
    """

    def through(x: Real, y: Real) -> Ray:
        return camera_ray(camera, height, x, y, middle)

    ray, push = jax.linearize(through, *film_point)
    zero = jnp.zeros_like(film_point[0])
    footprint = (push(zero + cell[0], zero), push(zero, zero + cell[1]))
    surface = nearest(ray, world, plan, jnp.full(zero.shape, -1, jnp.int32))
    on_glass = surface < plan.balls
    shown = emitted(surface, ray, footprint, world, emission, plan)
    return Path(
        ray,
        footprint,
        jnp.where(on_glass, surface, 0),
        jnp.full(zero.shape, -1, jnp.int32),
        jnp.ones_like(zero),
        jnp.where(on_glass, 0.0, shown),
        jnp.zeros(zero.shape, jnp.int32),
        on_glass & (plan.depth > 1),
    )


def surface_indices(
    point: Vec3, normal: Vec3, ball: Array, indices: Array, world: World, plan: Plan
) -> tuple[Real, Real, jax.Array]:
    """Index outside and inside of a ball's surface, and whether there is an interface at all.

    The medium is the smallest glass ball that contains the point just off the surface (of equal
    ones the later), else air.
    """
    if not plan.nested:
        return jnp.ones_like(point.x), _pick(indices, ball), jnp.ones(point.x.shape, bool)
    off = _pick(world.radii, ball) * (1e-8 if plan.dtype == "float64" else 1e-4)
    n_out, n_in = (
        _medium(point + normal * (off * sign), ball, sign < 0, indices, world, plan)
        for sign in (1.0, -1.0)
    )
    return n_out, n_in, n_out != n_in


def _medium(
    beside: Vec3, ball: Array, inside: bool, indices: Array, world: World, plan: Plan
) -> Real:
    """Index of the medium at a point just off the surface of `ball`, on a side that is known."""
    smallest, index = jnp.full_like(beside.x, jnp.inf), jnp.ones_like(beside.x)
    for number in range(plan.balls):
        offset = beside - vec3_row(world.centers, number)
        radius = world.radii[number]
        within = jnp.where(ball == number, inside, offset.dot(offset) < radius * radius)
        nearer = within & (radius <= smallest)
        smallest = jnp.where(nearer, radius, smallest)
        index = jnp.where(nearer, indices[number], index)
    return index


def vec3_row(table: Vec3, number: int) -> Vec3:
    """Row `number` of a table of vectors."""
    return Vec3(table.x[number], table.y[number], table.z[number])


def bounce(
    path: Path,
    branch: Callable[[Array], Real],
    indices: Float[Array, " balls"],
    world: World,
    emission: Emission,
    plan: Plan,
    inside: Array | bool,
    cutoff: Real,
    one: Array | None,
) -> Path:
    """The path advanced by one glass surface.

    Args:
        path: a path on its way to a ball.
        branch: from the number of the bounce to a number in [0, 1) that chooses.
        indices: index of each ball's glass at the path's wavelength.
        world: the scene's tables.
        emission: what ends paths.
        plan: the scene's static choices.
        inside: whether the path is inside its ball; True or False where all paths are.
        cutoff: part of its light with which a path ends.
        one: as in `once`.
    """
    center, radius = _pick_vector(world.centers, path.ball), _pick(world.radii, path.ball)

    def scatter(ray: Ray) -> tuple[tuple[Ray, Ray], tuple[Real, Array]]:
        distance = _distance_to_ball(ray, center, radius, path, plan, inside)
        outward = normalize(ray.origin + ray.direction * distance - center)
        point = center + outward * radius
        cosine = ray.direction.dot(outward)
        # A border within glass, or a camera there, shows its side only here.
        leaves = cosine > 0 if plan.nested else inside
        n_out, n_in, differ = surface_indices(point, outward, path.ball, indices, world, plan)
        eta = choose(leaves, n_out / n_in, n_in / n_out)
        facing = choose(leaves, -outward, outward)
        cos_i = jnp.abs(cosine)
        cos_t = cos_transmitted(cos_i, eta)
        mirrored = reflect(ray.direction, facing, cos_i)
        bent = refract(ray.direction, facing, cos_i, cos_t, eta)
        outer = Ray(point, choose(leaves, bent, mirrored))
        inner = Ray(point, choose(leaves, mirrored, bent))
        reflectance = jnp.where(differ, fresnel_reflectance(cos_i, cos_t, eta), 0.0)
        outer_share = choose(leaves, 1.0 - reflectance, reflectance)
        return (outer, inner), (outer_share, differ)

    (outer, inner), tangents, (outer_share, differ) = once(
        lambda: push_forward(scatter, path.ray, path.footprint), one
    )
    outer_print, inner_print = (tuple(t[i] for t in tangents) for i in (0, 1))
    inner_share = 1.0 - outer_share

    surface, light = _next(outer, outer_print, path.ball, world, emission, plan)
    arrives = path.alive & (surface >= plan.balls)
    radiance = path.radiance + jnp.where(arrives, path.throughput * outer_share * light, 0.0)
    outer_goes, outer_ball = (surface < plan.balls) & (outer_share > 0), surface
    inner_goes, inner_ball = inner_share > 0, path.ball
    if plan.nested:
        surface, light = _next(inner, inner_print, path.ball, world, emission, plan)
        arrives = path.alive & (surface >= plan.balls)
        radiance = radiance + jnp.where(arrives, path.throughput * inner_share * light, 0.0)
        inner_goes, inner_ball = inner_goes & (surface < plan.balls), surface

    share, goes_on, ball = inner_share, inner_goes, inner_ball
    ray, footprint = inner, inner_print
    if plan.random:  # with one ball, whatever leaves it never comes back
        chance = jnp.where(inner_goes, jax.lax.stop_gradient(outer_share), 1.0)
        chance = jnp.where(outer_goes, chance, 0.0)
        go_out = branch(path.bounces) < chance
        share, goes_on, ball, ray, footprint = choose(
            go_out,
            (outer_share, outer_goes, outer_ball, outer, outer_print),
            (inner_share, inner_goes, inner_ball, inner, inner_print),
        )
        share = share / jnp.where(go_out, chance, 1.0 - chance)

    throughput = path.throughput * share
    bounces = path.bounces + jnp.where(differ, 1, 0)
    # A path of b bounces has b + 1 segments, and the light that it adds next came over one more.
    alive = path.alive & goes_on & (throughput > cutoff) & (bounces < plan.depth - 1)
    moved = Path(ray, footprint, ball, path.ball, throughput, path.radiance, bounces, path.alive)
    # A path that has ended stays where it was: its numbers stay finite.
    kept = choose(alive, moved, path)
    return kept._replace(radiance=radiance, alive=alive)


def _next(
    ray: Ray,
    footprint: tuple[Ray, Ray],
    ball: Array,
    world: World,
    emission: Emission,
    plan: Plan,
) -> tuple[Array, Float[Array, " channels"]]:
    """The surface that a ray from `ball` meets first, and what that one emits."""
    surface = nearest(ray, world, plan, ball)
    return surface, emitted(surface, ray, footprint, world, emission, plan)


def _distance_to_ball(
    ray: Ray, center: Vec3, radius: Real, path: Path, plan: Plan, inside: Array | bool
) -> Real:
    """Distance to the ball that the path is known to meet next."""
    across = -2.0 * (ray.origin - center).dot(ray.direction)
    if inside is True:
        return across
    near, far, _ = sphere_distances(ray, center, radius)
    ahead = jnp.where(near > 0, near, far) if plan.nested else near
    return choose(inside, across, ahead)


def once(stage: Callable[[], Any], one: Array | None) -> Any:
    """`stage()`, computed once.

    XLA's CPU backend fuses loops by computing a value again in each of its users, through any
    number of stages. A loop is a border that it does not fuse across, and one whose trip count is
    known only at run time it does not unroll. Without `one` the stage is called as it is, as
    reverse mode needs it.

    Args:
        stage: what to compute.
        one: the number 1, as an array that the compiler does not know.
    """
    if one is None:
        return stage()
    empty = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(stage))
    return jax.lax.fori_loop(jnp.zeros_like(one), one, lambda _, old: stage(), empty)


class Lanes(NamedTuple):
    """The film samples of some pixels: everything but the indices of the glasses.

    Lanes are (wavelengths J, samples S, pixels P). What does not depend on the wavelength has
    no such axis, and is traced once for all of them. `weights` are those of the samples that meet
    glass; the others count alike. A path ends when less than `cutoff` of its light is left.
    `one` is as in `once`.
    """

    world: World
    emission: Emission
    weights: Float[Array, "wavelengths samples channels"] | None
    camera: Camera
    height: Real
    middle: tuple[Real, Real]
    cell: tuple[Real, Real]
    x: Float[Array, "samples pixels"]
    y: Float[Array, "samples pixels"]
    pixel: Array
    sample: Array
    seed: Array
    cutoff: Real
    one: Array | None


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def lane_radiance(
    plan: Plan, indices: tuple[Array, ...], lanes: Lanes
) -> Float[Array, "wavelengths samples pixels channels"]:
    """What each lane adds to its pixel.

    Light knows a glass only by its index at the light's own wavelength. So all derivatives in a
    glass's coefficients are one tangent, ∂L/∂n, times ∂n/∂(B, C): forward and reverse mode both
    cost one forward tangent, and reverse mode stores no path.

    Args:
        plan: the scene's static choices.
        indices: for each ball its glass's index, (J,) or, where every sample has wavelengths of
            its own, (J, S).
        lanes: all else.

    Returns:
        Weighted radiance (J, S, P, channels), to be summed over the axes that the film sums; with
        one index for all samples they are summed already and S is 1.
    """
    return _radiance(plan, indices, lanes, _until_done)


@partial(lane_radiance.defjvp, symbolic_zeros=True)
def _lane_radiance_jvp(
    plan: Plan, primals: tuple[Any, Any], tangents: tuple[Any, Any]
) -> tuple[Any, Any]:
    indices, lanes = primals
    slopes, radiance = [], None
    for ball, change in enumerate(tangents[0]):
        if isinstance(change, SymbolicZero):
            continue

        def of_index(index: Array, ball: int = ball) -> Array:
            changed = (*indices[:ball], index, *indices[ball + 1 :])
            return _radiance(plan, changed, lanes, _until_done)

        index = indices[ball]
        radiance, slope = jax.jvp(of_index, (index,), (jnp.ones_like(index),))
        slopes.append(slope * change.reshape(change.shape + (1,) * (4 - change.ndim)))
    if not all(isinstance(t, SymbolicZero) for t in jax.tree.leaves(tangents[1], is_leaf=_zero)):
        changes = jax.tree.map(_instantiate, tangents[1], lanes, is_leaf=_zero)
        radiance, slope = jax.jvp(
            lambda lanes: _radiance(plan, indices, lanes._replace(one=None), _bounded),
            (lanes,),
            (changes,),
        )
        slopes.append(slope)
    if radiance is None:
        radiance = lane_radiance(plan, indices, lanes)
    return radiance, sum(slopes, jnp.zeros_like(radiance))


def _zero(leaf: object) -> bool:
    return isinstance(leaf, SymbolicZero)


def _instantiate(tangent: object, primal: Array) -> object:
    return zero_from_primal(primal) if _zero(tangent) else tangent  # type: ignore[no-untyped-call]


Loop = Callable[[Callable[[Path], Path], Path, Plan], Path]


def _radiance(plan: Plan, indices: tuple[Array, ...], lanes: Lanes, loop: Loop) -> Array:
    """`lane_radiance`, with the loop that the wanted derivative allows."""
    world = lanes.world

    def start(x: Real, y: Real, emission: Emission) -> Path:
        return start_path(
            lanes.camera, world, emission, plan, lanes.height, (x, y), lanes.middle, lanes.cell
        )

    every = jax.vmap(jax.vmap(jax.vmap(start, (0, 0, None)), (0, 0, None)), (None, None, 0))
    paths = every(lanes.x, lanes.y, lanes.emission)
    met = jnp.any(paths.alive, axis=0)
    if plan.balls:
        paths = _through_glass(plan, indices, lanes, paths, loop)
    if lanes.weights is None:
        return jnp.mean(paths.radiance, axis=1, keepdims=True)
    alike = 1.0 / (lanes.weights.shape[0] * lanes.weights.shape[1])
    weights = jnp.where(met[None, :, :, None], lanes.weights[:, :, None, :], alike)
    return paths.radiance * weights


def _through_glass(
    plan: Plan, indices: tuple[Array, ...], lanes: Lanes, paths: Path, loop: Loop
) -> Path:
    """The paths followed to their ends."""
    world = lanes.world
    steps = jnp.asarray(sequence_steps(plan.depth if plan.random else 1))
    index = jnp.stack(indices, axis=-1)
    by_sample = 0 if index.ndim == 3 else None

    def advance(
        path: Path,
        pixel: Array,
        sample: Array,
        index: Array,
        emission: Emission,
        inside: bool | None,
    ) -> Path:
        def branch(bounces: Array) -> Real:
            word = bounces.astype(jnp.uint32)
            step = steps[bounces]
            return low_discrepancy(pixel, sample, word, step, lanes.seed, plan.dtype)

        side = path.last == path.ball if inside is None else inside
        return bounce(path, branch, index, world, emission, plan, side, lanes.cutoff, lanes.one)

    def every_path(inside: bool | None) -> Callable[[Path], Path]:
        pixels = jax.vmap(partial(advance, inside=inside), (0, 0, None, None, None))
        samples = jax.vmap(pixels, (0, None, 0, by_sample, None))
        every = jax.vmap(samples, (0, None, None, 0, 0))
        return lambda paths: every(paths, lanes.pixel, lanes.sample, index, lanes.emission)

    if plan.balls > 1 or plan.nested:
        return loop(every_path(None), paths, plan)
    # One ball apart from all else is entered once; after that its paths stay inside.
    paths = _unless_done(every_path(False), paths)
    return loop(every_path(True), paths, plan)


def _until_done(advance: Callable[[Path], Path], paths: Path, plan: Plan) -> Path:
    """All paths to their ends; no derivative in reverse mode."""
    return jax.lax.while_loop(lambda paths: jnp.any(paths.alive), advance, paths)


def _bounded(advance: Callable[[Path], Path], paths: Path, plan: Plan) -> Path:
    """All paths to their ends in a fixed number of turns, idle ones skipped; any derivative."""
    # Borders between equal media count for no bounce; a chord meets two of each ball at most.
    turns = (plan.depth - 1) * (2 * plan.balls if plan.nested else 1)

    def turn(paths: Path, _: None) -> tuple[Path, None]:
        return _unless_done(advance, paths), None

    return jax.lax.scan(turn, paths, length=turns)[0]


def _unless_done(advance: Callable[[Path], Path], paths: Path) -> Path:
    return jax.lax.cond(jnp.any(paths.alive), advance, lambda paths: paths, paths)
