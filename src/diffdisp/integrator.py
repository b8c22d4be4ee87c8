"""The tracer: one path, one surface at a time.

At a glass surface a path has two continuations: the *outer* ray leaves the ball that was met,
the *inner* ray stays in it or enters it; one is the reflected and the other the refracted one.
A continuation that next meets a lamp, a screen or the background ends there: its light is added
at once, exactly. Of two that meet glass again one is chosen. So the orders of one ball are
summed without noise, and only several balls cost any.
"""

from collections.abc import Callable
from functools import partial, reduce
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero, zero_from_primal
from jaxtyping import Bool, Float, Int

from diffdisp.camera import Projection, camera_ray
from diffdisp.fresnel import cos_transmitted, fresnel_reflectance, reflection, refraction
from diffdisp.geometry import (
    Plane,
    Ray,
    Sphere,
    box_width,
    fine_first_distance,
    first_distance,
    plane_axes,
    plane_distance,
    soft_offset,
    sphere_depth,
    sphere_distances,
)
from diffdisp.material import Dielectric, Emitter, Lambertian, Material, Metal
from diffdisp.outline import Piece, part_within, sphere_pieces, whole_footprint
from diffdisp.planning import Plan
from diffdisp.sampling import Numbers, sharing, uniform_direction
from diffdisp.scene import Object, Scene, is_glass, texture_of
from diffdisp.texture import Checker, Solid, covered, filtered_square_wave, filtered_tiles
from diffdisp.vector import (
    Array,
    Real,
    Vec3,
    choose,
    inverse,
    inverse_root,
    least_square,
    module_of,
    normalize,
    safe_sqrt,
    vec3,
)


class World(NamedTuple):
    """The geometry of a scene as tables, rows in the order of the surfaces' numbers.

    Numbers are explained in `Plan`. Spheres are one table and planes the other.
    """

    centers: Vec3
    radii: Float[Array, " spheres"]
    points: Vec3
    normals: Vec3
    axes: tuple[Vec3, Vec3]
    fuzz: Float[Array, " metals"]


class Paint(NamedTuple):
    """What surfaces show: a row each, after the glass balls; the background is the last.

    A checker shows `mean` + m · `half` where m is +1 on its even tiles and -1 on its odd ones. Of
    what ends a path this is the radiance, of all others the share of the light that goes on.
    `scale` is one over the edge of a tile, `cubes` tells the 3-D checkers.
    """

    mean: tuple[Float[Array, "*lanes rows"], ...]
    half: tuple[Float[Array, "*lanes rows"], ...]
    scale: Float[Array, " rows"]
    cubes: Bool[Array, " rows"]


Channels = tuple[Real, ...]


class Path(NamedTuple):
    """A path, or one in each of many lanes, on its way to a surface that sends it on.

    `footprint` and `spectral` are None where nothing is integrated over the one, and where no
    weight waits for the first dispersive glass. So is `reflected`: what the path counts that is
    reflected where both ways are taken, 0 if none is followed. `choices` and `lit` are of paths
    that scatter and are differentiated. `stretch` is by what part of itself a step of the film
    turns the camera's ray less from one end of each edge of the footprint to the other; where
    there are tiles. `chord` is of paths inside the only ball.
    """

    ray: Ray
    footprint: tuple[Ray, Ray] | None
    surface: Int[Array, "..."]
    last: Int[Array, "..."]
    throughput: tuple[Real, ...]
    radiance: tuple[Real, ...]
    bounces: Int[Array, "..."]
    alive: Array
    spectral: Array | None
    reflected: Real | None
    choices: "Choices | None" = None
    lit: "Lit | None" = None
    stretch: tuple[Real, Real] | None = None
    chord: "Chord | None" = None


class Chord(NamedTuple):
    """Where a path is inside the only ball.

    Light that enters a ball stays in the plane of its direction and of the normal there: those are
    what `Path.ray` holds, and its footprint their changes. The normal wherever it meets the ball
    later, and its direction, are so much of the one and so much of the other, by numbers that
    depend on the cosine at which it entered, and on nothing else of the ray. So are derivatives:
    what would be a dozen numbers of a footprint is one for each of these.

    Args:
        cosine: to the ball, outside of it, ≥ 0.
        tilts: its changes along both edges of the footprint.
        inner: the same cosine inside.
        bend: derivative of `inner` in `cosine`.
        share: of the light that the surface reflects, from either side.
        place: so much of both is the normal where the path was last, and so much its direction.
        turns: derivatives of `place` in `cosine`.
        size: radius of the ball on which the path lies.
        swells: its changes along both edges.
    """

    cosine: Real
    tilts: tuple[Real, Real]
    inner: Real
    bend: Real
    share: Real
    place: tuple[Real, Real, Real, Real]
    turns: tuple[Real, Real, Real, Real]
    size: Real
    swells: tuple[Real, Real]


class Choices(NamedTuple):
    """What a path has chosen before it scatters.

    Args:
        number: in [0, 1), uniform whatever has been chosen: one number serves all choices.
        chance: of all that has been chosen.
        code: a number for what that is.
    """

    number: Real
    chance: Real
    code: Int[Array, "..."]

    def made(self, chance: Real) -> "tuple[Array, Choices]":
        """Whether something is chosen by its chance, which has no derivative, and what is then."""
        chosen = self.number < chance
        counted = jnp.where(chosen, chance, 1.0 - chance)
        rest = jnp.where(chosen, self.number, self.number - chance)
        rest = rest / jnp.where(counted > 0, counted, 1.0)
        code = self.code * 2 + jnp.where(chosen, 2, 1)
        return chosen, Choices(rest, self.chance * counted, code)


class Lit(NamedTuple):
    """Where a path scattered first, and how it came there.

    Args:
        throughput: of the path from there on; 0 where it has not scattered.
        before: radiance that it had by then.
        surface: that it was; -1 where it has not.
        ray: that met it, or the camera's where it has not.
        footprint: of that ray.
        last: number of the surface that it came from.
        met: how many surfaces it had met before.
    """

    throughput: Channels
    before: Channels
    surface: Int[Array, "..."]
    ray: Ray
    footprint: tuple[Ray, Ray]
    last: Int[Array, "..."]
    met: Int[Array, "..."]


def surfaces_of(scene: Scene) -> list[Object]:
    """The objects in the order of the surfaces' numbers."""

    def rank(obj: Object) -> int:
        sphere = isinstance(obj.shape, Sphere)
        material = type(obj.material)
        if material is Emitter:
            return 5 if sphere else 6
        if sphere:
            return {Dielectric: 0, Metal: 1, Lambertian: 2}[material]
        return 3 if material is Lambertian else 4

    return sorted(scene.objects, key=rank)


def world_tables(scene: Scene) -> World:
    """The scene's geometry as tables, by NumPy if the scene holds its arrays."""
    surfaces = surfaces_of(scene)
    spheres = [obj.shape for obj in surfaces if isinstance(obj.shape, Sphere)]
    planes = [obj.shape for obj in surfaces if isinstance(obj.shape, Plane)]
    normals = [normalize(vec3(p.normal)) for p in planes]
    axes = [plane_axes(normal) for normal in normals]
    return World(
        _table([vec3(s.center) for s in spheres]),
        _row([s.radius for s in spheres]),
        _table([vec3(p.point) for p in planes]),
        _table(normals),
        (_table([u for u, _ in axes]), _table([v for _, v in axes])),
        _row([obj.material.fuzz for obj in surfaces if isinstance(obj.material, Metal)]),
    )


def paint_table(scene: Scene) -> Paint:
    """What the scene's surfaces and its background show, in linear sRGB; as `world_tables`."""
    color = scene.background.color
    zero = 0.0 * color[0]
    rows = [_even_odd_scale(obj.material, zero) for obj in surfaces_of(scene) if not is_glass(obj)]
    rows.append((color, color, zero, False))
    even, odd = (_row([row[i] for row in rows]).T for i in (0, 1))
    return Paint(
        tuple(0.5 * (even + odd)),
        tuple(0.5 * (even - odd)),
        _row([row[2] for row in rows]),
        np.array([row[3] for row in rows]),
    )


def _even_odd_scale(material: Material, zero: Real) -> tuple[Array, Array, Real, bool]:
    """What even and odd tiles show, one over their edge, and whether they are cubes."""
    texture = texture_of(material)
    assert texture is not None
    factor = material.intensity if isinstance(material, Emitter) else zero + 1.0
    if isinstance(texture, Solid):
        color = texture.color * factor
        return color, color, zero, False
    scale = texture.scale / np.pi if isinstance(texture, Checker) else 1.0 / texture.tile
    even, odd = (color * factor for color in (texture.even, texture.odd))
    return even, odd, scale, isinstance(texture, Checker)


def _row(values: list[Any]) -> Any:
    return module_of(*values).stack(values) if values else np.zeros(0)


def _table(vectors: list[Vec3]) -> Vec3:
    return Vec3(*(_row([v[axis] for v in vectors]) for axis in range(3)))


FEW = 4
"""Rows of a table among which to choose takes less time than to look up one."""


def _pick(table: Array, index: Array | int) -> Array:
    """A row of a table that has it; of a table of one row, that row."""
    if isinstance(index, int) or table.shape[0] > FEW:
        return look_up(table, index)
    row = jnp.asarray(table[0])
    for number in range(1, table.shape[0]):
        row = jnp.where(index == number, table[number], row)
    return row


def look_up(table: Array, *place: Array | int) -> Array:
    """An element of a table that has it: no place is negative or past the end."""
    rows = jnp.asarray(table).at[place]
    return rows.get(mode="promise_in_bounds", wrap_negative_indices=False)


def _pick_vector(table: Vec3, index: Array | int) -> Vec3:
    return Vec3(*(_pick(component, index) for component in table))


class Candidates(NamedTuple):
    """Spheres that a ray can meet, as a table with rows to spare.

    Args:
        centers: of the spheres; a row to spare has no size.
        radii: of the spheres.
        numbers: of the surfaces; None where rows are those of the scene's table.
        groups: how many groups of `group` rows count.
        group: rows of a group, which are taken together.
        several: whether there may be more groups than one.
        one: as in `once`.
    """

    centers: Vec3
    radii: Float[Array, " rows"]
    numbers: Int[Array, " rows"] | None
    groups: Int[Array, ""] | int
    group: int
    several: bool
    one: Array | None


MOST_TOGETHER = 8
"""Spheres taken together: more of them spill from the processor's registers."""


def all_spheres(world: World, plan: Plan, one: Array | None) -> Candidates:
    """The table of all spheres; `one` as in `once`."""
    groups = -(-plan.spheres // MOST_TOGETHER)
    group = -(-plan.spheres // groups) if groups else 0
    spare = groups * group - plan.spheres

    def filled(row: Array) -> Array:
        return jnp.pad(jnp.asarray(row), (0, spare)) if spare else jnp.asarray(row)

    return Candidates(
        Vec3(*map(filled, world.centers)),
        filled(world.radii),
        None,
        groups,
        group,
        groups > 1,
        one,
    )


def nearest(
    ray: Ray,
    world: World,
    plan: Plan,
    last: Array,
    spheres: Candidates,
    footprint: tuple[Ray, Ray] | None = None,
    without: Array | None = None,
    spread: Real | None = None,
) -> Array:
    """Number of the surface that a ray meets first.

    Args:
        ray: the ray; nothing is differentiated here, a number has no derivative.
        world: the scene's tables.
        plan: its static choices.
        last: number of the surface on which the ray starts, -1 for none. Its own distance of
            zero is divided out, so that no offset is needed to leave it.
        spheres: those that the ray can meet.
        footprint: of the ray; where outlines are soft, a part of it that meets one counts as all.
        without: number of a surface that is left out.
        spread: what a cone around the ray widens by along a unit of its length; a ball that it may
            meet counts.
    """
    ray, world, centers, radii, footprint, spread = jax.lax.stop_gradient(
        (ray, world, spheres.centers, spheres.radii, footprint, spread)
    )
    squares = radii * radii
    word = jnp.int64 if plan.dtype == "float64" else jnp.int32
    rows = np.asarray((1 << max(spheres.group - 1, 0).bit_length()) - 1, word)

    reach = footprint if plan.soft or plan.filtered else None

    def number_at(place: Array | int) -> Array:
        if spheres.numbers is not None:
            return _pick(spheres.numbers, place)
        lamps_on = plan.first_lamp - plan.first_plane
        return jnp.where(place < plan.first_plane, place, place + lamps_on)

    def of_group(group: Array | int) -> Array:
        """The nearest of a group: its distance, with its row in the last bits.

        Distances that differ in these alone are alike to rounding. Positive numbers are in the
        order of the words that hold them, so that one word tells both; two results would each
        compute all distances for itself.
        """
        words = []
        for row in range(spheres.group):
            place = group * spheres.group + row
            center, number = _pick_vector(centers, place), number_at(place)
            sphere = center, radii[place], squares[place]
            distance, meets = _sphere_ahead(ray, *sphere, number == last, plan)
            if reach is not None:
                along, depth, edges = sphere_depth(ray, reach, center, radii[place])
                grazes = (depth <= 0) & (depth + 0.5 * box_width(edges) > 0) & (along > 0)
                outlined = jnp.where(number < plan.balls, plan.soft, plan.filtered)
                grazes = grazes & outlined & (number != last)
                distance, meets = jnp.where(grazes, along, distance), meets | grazes
            if spread is not None:
                grazes, along = _passes_by(ray, center, radii[place], spread)
                grazes = grazes & ~meets & (number < plan.balls)
                distance, meets = jnp.where(grazes, along, distance), meets | grazes
            if without is not None:
                meets = meets & (number != without)
            far = jnp.where(meets, distance, jnp.inf)
            words.append((jax.lax.bitcast_convert_type(far, word) & ~rows) | np.asarray(row, word))
        return reduce(jnp.minimum, words)

    def nearer(group: Array | int, found: Array, best: tuple[Array, Array]) -> tuple[Array, Array]:
        closer = found < best[0]
        return jnp.where(closer, found, best[0]), jnp.where(closer, group, best[1])

    none = jax.lax.bitcast_convert_type(jnp.full_like(ray.direction.x, jnp.inf), word)
    best: Array = none
    group: Array = jnp.zeros_like(last)
    if spheres.group and not spheres.several:
        best = once(lambda: of_group(0), spheres.one)
    elif spheres.group:

        def turn(number: Array, carried: Any) -> Any:
            """The group of the last turn is compared while that of this one is looked at."""
            best, found = carried
            return nearer(number - 1, found, best), of_group(number)

        carried = jax.lax.fori_loop(0, spheres.groups, turn, ((best, group), none))
        best, group = nearer(jnp.asarray(spheres.groups, jnp.int32) - 1, carried[1], carried[0])
    distance = jax.lax.bitcast_convert_type(best & ~rows, ray.origin.x.dtype)
    number: Array = jnp.full_like(last, plan.background)
    if spheres.group:
        place = group * spheres.group + (best & rows).astype(jnp.int32)
        number = jnp.where(distance < jnp.inf, number_at(place), number)
    for row, plane in enumerate(surface_numbers(plan)[1]):
        point, normal = vec3_row(world.points, row), vec3_row(world.normals, row)
        to_plane = plane_distance(ray, point, normal)
        if reach is not None and plan.filtered:
            across, down = (edge.direction.dot(normal) for edge in reach)
            grazes = jnp.abs(ray.direction.dot(normal)) < 0.5 * box_width((across, down))
            to_plane = jnp.where(grazes, jnp.abs(to_plane), to_plane)
        closer = (to_plane > 0) & (last != plane) & (to_plane < distance)
        if without is not None:
            closer = closer & (plane != without)
        distance = jnp.where(closer, to_plane, distance)
        number = jnp.where(closer, plane, number)
    return number


def _sphere_ahead(
    ray: Ray, center: Vec3, radius: Real, squared: Real, on: Array, plan: Plan
) -> tuple[Real, Array]:
    """`first_distance`, with more digits where the scene asks for them."""
    if plan.fine:
        return fine_first_distance(ray, center, radius, on)
    return first_distance(ray, center, squared, on)


def _passes_by(ray: Ray, center: Vec3, radius: Real, spread: Real) -> tuple[Array, Real]:
    """Whether a cone around a ray may meet a sphere ahead, and how far along the ray that is.

    Args:
        ray: the middle of the cone.
        center: the sphere's.
        radius: the sphere's.
        spread: what the cone widens by along a unit of its length.
    """
    to_origin = ray.origin - center
    along = -to_origin.dot(ray.direction)
    foot, reach = to_origin + ray.direction * along, radius + spread * along
    outside = to_origin.dot(to_origin) > radius * radius
    return outside & (along > 0) & (foot.dot(foot) < reach * reach), along


def surface_numbers(plan: Plan) -> tuple[np.ndarray, np.ndarray]:
    """The number of each row of the table of spheres, and of the table of planes."""
    numbers = np.arange(plan.background, dtype=np.int32)
    before, lamps, screens = np.split(numbers, [plan.first_lamp, plan.first_lamp + plan.lamps])
    spheres, planes = np.split(before, [plan.first_plane])
    return np.concatenate([spheres, lamps]), np.concatenate([planes, screens])


def _over(step: Callable[[Any, Any], tuple[Any, None]], start: Any, rows: Any, count: int) -> Any:
    """`step` over the rows of a table, eight to a turn of the loop; few rows make no loop."""
    return jax.lax.scan(step, start, rows, unroll=min(count, 8))[0] if count else start


def pushed(of: Callable[[Any], Any], value: Any, edges: Any) -> tuple[Any, Any]:
    """`of(value)`, and its derivatives along both edges of a footprint."""
    result, push = jax.linearize(of, value)
    return result, tuple(push(edge) for edge in edges)


def _staged(
    one: Array | None, of: Callable[[Any], Any], value: Any, *edges: Any
) -> tuple[Any, Any]:
    """`pushed`, computed once; `one` is as in `once`."""
    return once(lambda: pushed(of, value, edges), one)


def painted(
    surface: Array,
    path: Path,
    point: Callable[[Any], Vec3],
    met: Any,
    edges: tuple[Any, Any] | None,
    tables: "Tables",
    plan: Plan,
    emits: bool,
    one: Array | None,
) -> Channels:
    """What a surface, which is not glass, shows to a ray.

    Args:
        surface: its number.
        path: on its way to it.
        point: from `met` to where the ray meets the surface; a little beneath it.
        met: what tells that.
        edges: the derivatives of `met` along both edges of a footprint, if there is one.
        tables: the scene.
        plan: its static choices.
        emits: whether the surface ends paths, as all those do that are asked for here.
        one: as in `once`.
    """
    paint, mean, half = tables.paint, tables.paint.mean, tables.paint.half
    first, end = 0, plan.first_lamp - plan.balls
    if emits:
        first, end = end, plan.background + 1 - plan.balls
    row: Array | int = first
    if end - first > 1:
        row = jnp.clip(surface - plan.balls, first, end - 1)
    place = row + tables.first_row
    tiled, cubed = (kinds[emits] for kinds in (plan.tiled, plan.cubed))
    if not (tiled or cubed):
        return tuple(_pick(channel, place) for channel in mean)
    scale = _pick(paint.scale, row)
    waves: list[Callable[[Any], tuple[Real, ...]]] = []
    if tiled:
        plane = _plane_row(surface, plan)

        def on_tiles(met: Any) -> tuple[Real, ...]:
            offset = point(met) - _pick_vector(tables.world.points, plane)
            u, v = (_pick_vector(axis, plane) for axis in tables.world.axes)
            return offset.dot(u) * scale, offset.dot(v) * scale

        waves.append(on_tiles)
    if cubed:
        waves.append(lambda met: tuple(point(met) * scale))
    is_cubes = _pick(paint.cubes, row) if tiled and cubed else None
    if edges is None:

        def row_of_both() -> Array:
            odd = _one_of([_is_odd(wave(met)) for wave in waves], is_cubes)
            return place + jnp.where(odd, mean[0].shape[0], 0)

        # Even and odd rows in one table: a look-up costs more than all else here.
        place = once(row_of_both, one)
        both = (jnp.concatenate([m + h, m - h]) for m, h in zip(mean, half, strict=True))
        return tuple(_pick(channel, place) for channel in both)
    mixes = []
    if tiled:
        normal = _pick_vector(tables.world.normals, plane)
        mixes.append(_filtered_tiles(on_tiles, met, edges, _bends(path, normal), one))
    if cubed:
        mixes.append(_filtered_cubes(waves[-1], met, edges, one))
    mix = _one_of(mixes, is_cubes)
    return tuple(_pick(m, place) + _pick(h, place) * mix for m, h in zip(mean, half, strict=True))


def _one_of(found: list[Array], second: Array | None) -> Array:
    """The first, or where there are two the second if it is asked for."""
    return found[0] if second is None else jnp.where(second, found[1], found[0])


def _is_odd(coordinates: tuple[Real, ...]) -> Array:
    """Whether a point is in an odd tile or cube: by one parity of all floors."""
    cells = reduce(jnp.add, map(jnp.floor, coordinates))
    return jnp.asarray(cells != 2.0 * jnp.floor(0.5 * cells))


def _filtered_tiles(
    coordinates: Callable[[Any], tuple[Real, ...]],
    met: Any,
    edges: tuple[Any, Any],
    bends: tuple[Real, Real],
    one: Array | None,
) -> Real:
    """The mean over a footprint of +1 on even and -1 on odd tiles: that of its two halves.

    Args:
        coordinates: from `met` to where on the tiles that is.
        met: the footprint's middle.
        edges: of the footprint.
        bends: as `_bends` tells; what is divided is the edge along which that is more.
        one: as in `once`.
    """
    values, reaches = _staged(one, coordinates, met, *edges)
    swap = jnp.abs(bends[1]) > jnp.abs(bends[0]) + UNBENT
    (bend, aside), (along, beside) = choose(
        swap, (bends[::-1], reaches[::-1]), (bends, tuple(reaches))
    )

    def half(place: float) -> tuple[Any, Any, Any]:
        """The half about a place of the edge."""
        nearer = inverse(1.0 + place * bend)
        middle = tuple(v + a * (place * nearer) for v, a in zip(values, along, strict=True))
        square = nearer * nearer
        own = tuple(0.5 * square * a for a in along)
        other = tuple(
            square * (b + place * (bend * b - aside * a))
            for a, b in zip(along, beside, strict=True)
        )
        return middle, own, other

    halves = once(lambda: (half(-0.25), half(0.25)), one)
    return 0.5 * sum(once(partial(filtered_tiles, *part), one) for part in halves)


MOST_BENT = 2.0
"""At twice its own cosine along an edge a footprint reaches the horizon, where all is its mean."""


UNBENT = 1e-3
"""A difference of bends that says nothing: head on both are rounding, and a footprint that is no
rectangle looks otherwise by the halves of its other edge. A picture has the square of it wrong."""


def _bends(path: Path, normal: Vec3) -> tuple[Real, Real]:
    """By what part of itself the cosine to a plane changes along both edges of a footprint.

    A plane sees rays in perspective: what is even on the film is further apart where it is farther
    away. To first order a footprint does not know that, and near the horizon it is most of what a
    picture of few samples has wrong.
    """
    assert path.footprint is not None
    cosine = path.ray.direction.dot(normal)
    cosine = jnp.where(cosine == 0, 1.0, cosine)
    assert path.stretch is not None
    edges = zip(path.footprint, path.stretch, strict=True)
    scale = inverse(cosine)
    across, down = (edge.direction.dot(normal) * scale + by for edge, by in edges)
    return jnp.clip(across, -MOST_BENT, MOST_BENT), jnp.clip(down, -MOST_BENT, MOST_BENT)


def _filtered_cubes(
    coordinates: Callable[[Any], tuple[Real, ...]],
    met: Any,
    edges: tuple[Any, Any],
    one: Array | None,
) -> Real:
    """The mean over a footprint of +1 in even and -1 in odd cubes.

    That of three waves at once, by those of two at a time, as if no three went together: exact
    where no more than two of them change within the footprint.
    """
    values, reaches = _staged(one, coordinates, met, *edges)
    axes = list(zip(values, *reaches, strict=True))
    alone = once(lambda: [filtered_square_wave(*axis) for axis in axes], one)
    mean: Real = -2.0 * alone[0] * alone[1] * alone[2]
    for third in range(3):
        two = [axis for number, axis in enumerate(axes) if number != third]
        mean = mean + alone[third] * once(partial(filtered_tiles, *zip(*two, strict=True)), one)
    return mean


def _beneath(point: Vec3, outward: Vec3, surface: Array, tables: "Tables", plan: Plan) -> Vec3:
    """So little beneath a point of a surface that it is certain in which cube.

    That is 1e-4 of a cube's edge. Points of a sphere are rounded by its radius: beneath a large one
    it is more.
    """
    if not any(plan.cubed):
        return point
    world, scale = tables.world, _pick(tables.paint.scale, jnp.maximum(surface - plan.balls, 0))
    depth = 1e-4 / jnp.where(scale > 0, scale, 1.0)
    if plan.spheres > plan.balls:
        row, is_sphere = _sphere_row(surface, plan)
        rounding = float(np.finfo(plan.dtype).eps) * _pick(world.radii, row)
        depth = jnp.where(is_sphere, jnp.maximum(depth, rounding), depth)
    return point - outward * depth


def emitted(
    surface: Array, path: Path, tables: "Tables", plan: Plan, one: Array | None
) -> Channels:
    """Radiance of the surface that ends a path."""
    world = tables.world
    sphere, _ = _sphere_row(surface, plan)
    plane = _plane_row(surface, plan)
    on_lamp = (surface >= plan.first_lamp) & (surface < plan.first_lamp + plan.lamps)
    on_screen = (surface >= plan.first_lamp + plan.lamps) & (surface < plan.background)

    def reach(ray: Ray) -> Real:
        distance = jnp.zeros_like(ray.direction.x)
        if plan.screens:
            distance = jnp.where(on_screen, _to_plane(ray, plane, on_screen, world), distance)
        if plan.lamps and plan.cubed[True]:
            near, far, _ = sphere_distances(ray, *lamp())
            distance = jnp.where(on_lamp, jnp.where(near > 0, near, far), distance)
        return distance

    def point(met: tuple[Ray, Real]) -> Vec3:
        ray, distance = met
        where, outward = ray.origin + ray.direction * distance, ray.direction
        if plan.screens:
            outward = choose(on_screen, _pick_vector(world.normals, plane), outward)
        if plan.lamps and plan.cubed[True]:
            center, radius = lamp()
            outward = choose(on_lamp, (where - center) * inverse(radius), outward)
        return _beneath(where, outward, surface, tables, plan)

    def lamp() -> tuple[Vec3, Real]:
        return _pick_vector(world.centers, sphere), _pick(world.radii, sphere)

    if path.footprint is None:
        return painted(
            surface,
            path,
            lambda ray: point((ray, reach(ray))),
            path.ray,
            None,
            tables,
            plan,
            True,
            one,
        )
    distance, gains = _staged(one, reach, path.ray, *path.footprint)
    across, down = zip(path.footprint, gains, strict=True)
    met, edges = (path.ray, distance), (across, down)
    return painted(surface, path, point, met, edges, tables, plan, True, one)


class Seen(NamedTuple):
    """One of the surfaces that end paths, to a footprint.

    Args:
        distance: along the ray to where it is met, or passed next to.
        part: of the footprint that meets it, were there nothing before it.
        light: what it shows there.
    """

    distance: Real
    part: Real
    light: Channels


def arriving(
    surface: Array,
    path: Path,
    tables: "Tables",
    plan: Plan,
    one: Array | None,
    clear: bool = False,
) -> Channels:
    """Mean radiance over a footprint whose middle meets a surface that ends paths.

    Lamps end at their silhouettes, and infinite screens at their horizons, which count where
    outlines are soft. Of a footprint across such an edge each side counts by its part; of several,
    the nearer ones hide the others by their parts. Where a ball of glass may be beside the edge,
    all counts as what the middle meets.

    Args:
        surface: what the middle meets.
        path: ray and footprint.
        tables: the scene.
        plan: its static choices.
        one: as in `once`.
        clear: whether the footprint is known to meet no ball of glass.
    """
    edges = plan.lamps or (plan.soft and plan.screens)
    if path.footprint is None or not edges:
        return emitted(surface, path, tables, plan, one)
    background = plan.background - plan.balls + tables.first_row
    seen = [_lamp_seen(row, path, tables, plan, one) for row in range(plan.lamps)]
    seen += [_screen_seen(row, path, tables, plan, one) for row in range(plan.screens)]
    if plan.balls and not clear:
        hard = _meets_glass(path, tables.world, plan)
        seen = [
            found._replace(part=jnp.where(hard, jnp.where(surface == number, 1.0, 0.0), found.part))
            for number, found in enumerate(seen, start=plan.first_lamp)
        ]
    total = tuple(jnp.zeros_like(mean[0]) for mean in tables.paint.mean)
    rest = jnp.ones_like(path.ray.origin.x)
    for number, found in enumerate(seen):
        left = found.part
        for other, before in enumerate(seen):
            # Of two at the same distance the one with the lower number is the nearer.
            nearer = before.distance < found.distance
            if other < number:
                nearer = before.distance <= found.distance
            if other != number:
                left = left * jnp.where(nearer, 1.0 - before.part, 1.0)
        total = tuple(t + left * x for t, x in zip(total, found.light, strict=True))
        rest = rest * (1.0 - found.part)
    return tuple(
        t + rest * _pick(mean, background) for t, mean in zip(total, tables.paint.mean, strict=True)
    )


def _meets_glass(path: Path, world: World, plan: Plan) -> Array:
    """Whether a part of a footprint may meet a ball of glass, or is within one."""
    meets = jnp.zeros(path.ray.origin.x.shape, bool)
    assert path.footprint is not None
    for row in range(plan.balls):
        center, radius = vec3_row(world.centers, row), world.radii[row]
        along, depth, edges = sphere_depth(path.ray, path.footprint, center, radius)
        offset = path.ray.origin - center
        # What leaves a ball starts on it, or within rounding of that.
        within = offset.dot(offset) < radius * radius * (1.0 - 1e-5)
        meets = meets | within | ((along > 0) & (depth + box_width(edges) > 0))
    return meets


def _lamp_seen(row: int, path: Path, tables: "Tables", plan: Plan, one: Array | None) -> Seen:
    """A lamp; of a checker on it, a footprint that only grazes it sees the mean."""
    world, number = tables.world, plan.first_lamp + row
    center, radius = (
        vec3_row(world.centers, plan.first_plane + row),
        world.radii[plan.first_plane + row],
    )
    assert path.footprint is not None
    along, depth, _ = sphere_depth(path.ray, path.footprint, center, radius)
    root = radius * safe_sqrt(depth, least_square(depth))
    offset = path.ray.origin - center
    around = offset.dot(offset) < radius * radius
    within = part_within(path.ray, path.footprint, center, radius)
    part = jnp.where(around, 1.0, jnp.where(along > 0, within, 0.0))
    place = number - plan.balls + tables.first_row
    light = tuple(_pick(mean, place) for mean in tables.paint.mean)
    if plan.cubed[True]:
        shown = emitted(_everywhere(number, depth), path, tables, plan, one)
        light = tuple(jnp.where(depth > 0, x, m) for x, m in zip(shown, light, strict=True))
    return Seen(along + jnp.where(around, root, -root), part, light)


def _screen_seen(row: int, path: Path, tables: "Tables", plan: Plan, one: Array | None) -> Seen:
    """A screen; where outlines are soft, up to its horizon, and there its tiles are their mean."""
    world, number = tables.world, plan.first_lamp + plan.lamps + row
    plane = plan.planes - plan.screens + row
    normal = vec3_row(world.normals, plane)
    height = (path.ray.origin - vec3_row(world.points, plane)).dot(normal)
    side = jnp.where(height < 0, 1.0, -1.0)

    def towards(ray: Ray) -> Real:
        return ray.direction.dot(normal) * side

    downward, edges = pushed(towards, path.ray, path.footprint)
    meets = downward > 0
    part: Real = jnp.where(meets, 1.0, 0.0)
    if plan.soft:
        part = covered(downward, *edges)
    part = jnp.where(height == 0, 0.0, part)
    ahead = jnp.abs(height) * inverse(jnp.where(meets, downward, 1.0))
    distance = jnp.where(meets, ahead, jnp.inf)
    shown = emitted(_everywhere(number, height), path, tables, plan, one)
    place = number - plan.balls + tables.first_row
    mean = (_pick(channel, place) for channel in tables.paint.mean)
    light = tuple(jnp.where(part < 1, m, x) for x, m in zip(shown, mean, strict=True))
    return Seen(distance, part, light)


def _everywhere(number: int, like: Real) -> Array:
    """The number of one surface, in the shape of `like`."""
    return jnp.full(jnp.shape(like), number, jnp.int32)


def _sphere_row(surface: Array, plan: Plan) -> tuple[Array, Array]:
    """The row of the table of spheres in which a surface stands that is one, and whether it is."""
    before_planes = surface < plan.first_plane
    lamp = (surface >= plan.first_lamp) & (surface < plan.first_lamp + plan.lamps)
    row = jnp.where(before_planes, surface, surface - plan.first_lamp + plan.first_plane)
    return jnp.clip(row, 0, max(plan.spheres - 1, 0)), before_planes | lamp


def _plane_row(surface: Array, plan: Plan) -> Array:
    """The row of the table of planes in which a surface stands that is one."""
    before = plan.matte_planes + plan.metal_planes
    row = surface - plan.first_plane
    if plan.screens:
        row = jnp.where(row < before, row, row - plan.lamps)
    return jnp.clip(row, 0, max(plan.planes - 1, 0))


def _to_plane(ray: Ray, plane: Array, valid: Array, world: World) -> Real:
    """Distance along a ray to a plane that it is known to meet; finite if rounding denies that."""
    point, normal = _pick_vector(world.points, plane), _pick_vector(world.normals, plane)
    cosine = ray.direction.dot(normal)
    cosine = jnp.where(valid & (cosine != 0), cosine, 1.0)
    return (point - ray.origin).dot(normal) * inverse(cosine)


class Tables(NamedTuple):
    """A scene as the tracer sees it.

    Args:
        world: its geometry.
        paint: what its surfaces show.
        first_row: of the rows of `paint` for the path's wavelength, where each has its own.
    """

    world: World
    paint: Paint
    first_row: Array | int = 0


def start_path(
    projection: Projection,
    tables: Tables,
    plan: Plan,
    film_point: tuple[Real, Real],
    cell: tuple[Real, Real],
    one: Array | None,
    choices: Choices | None = None,
) -> Path:
    """The path from a film point to its first surface; ended, unless that one sends it on.

    Args:
        projection: the camera and the picture's size.
        tables: the scene.
        plan: its static choices.
        film_point: pixels to the right of and below the picture's upper left corner.
        cell: width and height of the part of the film that the sample stands for, pixels.
        one: as in `once`.
        choices: of a path that makes some, before any is made: across an outline it sees one of
            two surfaces.
    """

    def through(piece: Piece) -> tuple[Ray, tuple[Ray, Ray]]:
        def at(x: Real, y: Real) -> Ray:
            return camera_ray(projection, film_point[0] + x * cell[0], film_point[1] + y * cell[1])

        ray, push = jax.linearize(at, *piece.middle)
        across, down = piece.edges
        return ray, (push(*across), push(*down))

    whole = whole_footprint(film_point[0])
    ray, edges = through(whole)
    footprint = None if plan.scattering and not plan.filtered else edges
    spheres = all_spheres(tables.world, plan, None)
    last = no_surface(film_point[0])
    if plan.cut:
        return _cut_at_outline(through, whole, projection, spheres, tables, plan, one)
    if choices is None:
        surface = nearest(ray, tables.world, plan, last, spheres, footprint)
    else:
        assert footprint is not None
        surface, share, choices = _one_of_seen(
            ray, footprint, last, choices, spheres, tables.world, plan
        )
    path = _from_camera(ray, footprint, surface, projection, plan)
    ends = surface >= plan.first_lamp
    if choices is None:
        shown = arriving(surface, path, tables, plan, one)
        return path._replace(radiance=tuple(jnp.where(ends, channel, 0.0) for channel in shown))
    shown = emitted(surface, path, tables, plan, one)
    radiance: Channels = tuple(jnp.where(ends, share * channel, 0.0) for channel in shown)
    counts = jnp.ones(surface.shape, bool)
    radiance = _against_chance(radiance, counts, path.throughput, share, tables, plan)
    throughput = tuple(t * share for t in path.throughput)
    return path._replace(throughput=throughput, radiance=radiance, choices=choices)


def _from_camera(
    ray: Ray,
    footprint: tuple[Ray, Ray] | None,
    surface: Array,
    projection: Projection,
    plan: Plan,
) -> Path:
    """A path that the camera sends to a surface, and what its footprint has for tiles."""
    path = new_path(ray, footprint, surface, plan)
    if footprint is None or not any(plan.tiled):
        return path
    # Off the middle of the picture a step of the film turns a ray the less.
    ahead = ray.direction.dot(projection.forward)
    across, down = (-edge.direction.dot(projection.forward) / ahead for edge in footprint)
    return path._replace(stretch=(across, down))


def _cut_at_outline(
    through: Callable[[Piece], tuple[Ray, tuple[Ray, Ray]]],
    whole: Piece,
    projection: Projection,
    spheres: Candidates,
    tables: Tables,
    plan: Plan,
    one: Array | None,
) -> Path:
    """A path that goes on into a ball with what of its footprint lies within the ball's outline.

    What lies beside the ball sees another surface; where that one ends paths it has been seen.
    Where it is a ball, too, the larger piece counts as all.

    Args:
        through: from a piece of the footprint to its middle's ray and its edges.
        whole: all of it.
        projection: as in `start_path`.
        spheres: all of the scene.
        tables: the scene.
        plan: its static choices.
        one: as in `once`.
    """
    world, nowhere = tables.world, no_surface(whole.part)

    def cut() -> tuple[Array, Piece, Piece]:
        """The ball that the footprint meets, what of it does, and the rest."""
        ray, footprint = through(whole)
        across, down = (safe_sqrt(edge.direction.dot(edge.direction)) for edge in footprint)
        spread = 0.5 * (across + down)
        surface = nearest(ray, world, plan, nowhere, spheres, spread=spread)
        ball, at_ball = jnp.minimum(surface, plan.balls - 1), surface < plan.balls
        center, radius = _pick_vector(world.centers, ball), _pick(world.radii, ball)
        along, inner, outer = sphere_pieces(ray, footprint, center, radius)
        around = at_ball & ~_starts_outside(ray, center, radius)
        misses = ~at_ball | (~around & (along <= 0))
        nothing = whole._replace(part=jnp.zeros_like(whole.part))
        inner = choose(around, whole, choose(misses, nothing, inner))
        outer = choose(misses, whole, choose(around, nothing, outer))
        return jnp.where(at_ball, surface, -1), inner, outer

    surface, inner, outer = once(cut, one)
    into, beside = (
        _from_camera(*through(piece), nowhere, projection, plan) for piece in (inner, outer)
    )
    behind = nearest(beside.ray, world, plan, nowhere, spheres, without=surface)
    ends = behind >= plan.first_lamp
    several = ~ends & (outer.part > 0)
    first = jnp.where(several, inner.part >= outer.part, inner.part > 0)
    part = jnp.where(several, 1.0, inner.part)
    shown = arriving(behind, beside, tables, plan, one, plan.balls == 1)
    seen = jnp.where(ends, outer.part, 0.0)
    alive = (first | several) & (plan.depth > 1)
    path = choose(first, into, beside)
    return path._replace(
        surface=jnp.where(alive, jnp.where(first, surface, behind), 0),
        throughput=(part,),
        radiance=tuple(seen * channel for channel in shown),
        alive=alive,
    )


def no_surface(like: Real) -> Array:
    """The number -1, which no surface has."""
    return _everywhere(-1, like)


def new_path(ray: Ray, footprint: tuple[Ray, Ray] | None, surface: Array, plan: Plan) -> Path:
    """A path that the camera sends to a surface."""
    zero = jnp.zeros_like(ray.direction.x)
    alive = (surface < plan.first_lamp) & (plan.depth > 1)
    parts = plan.scattering and plan.dispersive
    return Path(
        ray,
        footprint,
        jnp.where(alive, surface, 0),
        no_surface(zero),
        (jnp.ones_like(zero),) * (plan.channels if plan.scattering else 1),
        (zero,) * plan.channels,
        jnp.zeros(zero.shape, jnp.int32),
        alive,
        jnp.zeros(zero.shape, bool) if parts else None,
        zero if parts else None,
        None,
        _unlit(ray, footprint, plan) if plan.filtered else None,
    )


def _unlit(ray: Ray, footprint: tuple[Ray, Ray] | None, plan: Plan) -> Lit:
    """Of a path that has scattered nowhere."""
    assert footprint is not None
    none = (jnp.zeros_like(ray.direction.x),) * plan.channels
    nowhere = no_surface(ray.direction.x)
    return Lit(none, none, nowhere, ray, footprint, nowhere, jnp.zeros_like(nowhere))


Index = Callable[[Array | int], Real]
"""From the number of a ball to the index of its glass at the path's wavelength."""


def surface_indices(
    point: Vec3, normal: Vec3, ball: Array, index: Index, world: World, plan: Plan
) -> tuple[Real, Real, jax.Array]:
    """Index outside and inside of a ball's surface, and whether there is an interface at all.

    The medium is the smallest glass ball that contains the point just off the surface (of equal
    ones the later), else air.
    """
    if not plan.nested:
        return jnp.ones_like(point.x), index(ball), jnp.ones(point.x.shape, bool)
    off = _pick(world.radii, ball) * (1e-8 if plan.dtype == "float64" else 1e-4)
    n_out, n_in = (
        _medium(point + normal * (off * sign), ball, sign < 0, index, world, plan)
        for sign in (1.0, -1.0)
    )
    return n_out, n_in, n_out != n_in


def _medium(
    beside: Vec3, ball: Array, inside: bool, index: Index, world: World, plan: Plan
) -> Real:
    """Index of the medium at a point just off the surface of `ball`, on a side that is known."""
    smallest, found = jnp.full_like(beside.x, jnp.inf), jnp.ones_like(beside.x)
    for number in range(plan.balls):
        offset = beside - vec3_row(world.centers, number)
        radius = world.radii[number]
        within = jnp.where(ball == number, inside, offset.dot(offset) < radius * radius)
        nearer = within & (radius <= smallest)
        smallest = jnp.where(nearer, radius, smallest)
        found = jnp.where(nearer, index(number), found)
    return found


def vec3_row(table: Vec3, number: int) -> Vec3:
    """Row `number` of a table of vectors."""
    return Vec3(table.x[number], table.y[number], table.z[number])


class Interface(NamedTuple):
    """A glass surface to a ray: where the media on both sides `differ`, it reflects and refracts.

    `eta` is the index behind the surface over that before it.
    """

    eta: Real
    cos_t: Real
    reflectance: Real
    differ: Array


def glass_interface(
    media: tuple[Real, Real, Array], cos_i: Real, leaves: Array | bool
) -> Interface:
    """What the surface of a ball is to a ray that leaves the ball there, or does not.

    Args:
        media: as `surface_indices` tells.
        cos_i: cosine of the angle of incidence, ≥ 0.
        leaves: whether the ray leaves the ball.
    """
    n_out, n_in, differ = media
    eta = choose(leaves, n_out / n_in, n_in / n_out)
    cos_t = cos_transmitted(cos_i, eta)
    reflectance = jnp.where(differ, fresnel_reflectance(cos_i, cos_t, eta), 0.0)
    return Interface(eta, cos_t, reflectance, differ)


class Split(NamedTuple):
    """How both ways are taken where a sample meets dispersive glass first.

    The reflected path serves all channels, for it goes the same way at all wavelengths. It is
    followed the more often the more light it carries, and counts the more the less often.

    Args:
        now: whether this is the sample's first surface, and glass.
        reflects: whether this is the reflected path.
        ratios: the index of each channel, its mean over what the channel sees, over that at the
            path's wavelength.
    """

    now: Array
    reflects: Array
    ratios: Channels


class Setting(NamedTuple):
    """What a bounce needs beside its path.

    Args:
        tables: the scene.
        plan: its static choices.
        draw: from the number of the bounce, and which of its decisions, to a number in [0, 1).
        index_of: index of a ball's glass at the path's wavelength.
        weights: what the path counts once it has met dispersive glass; None where nothing does.
        always: whether the path counts before, too; None where nothing has weights.
        split: how paths part at the first surface; None where they never do.
        cutoff: part of its light with which a path ends.
        one: as in `once`.
        differentiable: whether derivatives may be asked for: then the chance of a choice, which is
            detached, is made up for, and ended paths keep finite numbers.
    """

    tables: Tables
    plan: Plan
    draw: Callable[[Array, int], Real]
    index_of: Index
    weights: Channels | None
    always: Array | None
    split: Split | None
    cutoff: Real
    one: Array | None
    differentiable: bool


def bounce(path: Path, setting: Setting, inside: bool | None = None) -> Path:
    """The path advanced by one surface.

    Args:
        path: a path on its way to a surface that sends it on.
        setting: the rest.
        inside: whether the path is inside its ball, where that is known of all paths: those of a
            ball apart from all other glass, which have room for a chord.
    """
    if setting.plan.scattering:
        return _one_way(path, setting)
    if inside is None:
        return _both_ways(path, setting)
    return _along_chord(path, setting) if inside else _enter(path, setting)


class Way(NamedTuple):
    """One of both continuations: its ray and footprint, and its share of the light."""

    ray: Ray
    footprint: tuple[Ray, Ray]
    share: Real


def _both_ways(path: Path, setting: Setting) -> Path:
    """A bounce in a scene that sends paths on only from glass: two ways, chosen at the end."""
    plan, ball = setting.plan, path.surface
    outer, inner, differ = _parting(path, setting)
    throughput = path.throughput[0]
    outer_surface, radiance = _arrive(outer, path, path.radiance, setting, False)
    outer_goes = (outer_surface < plan.first_lamp) & (outer.share > 0)
    inner_goes, inner_surface = inner.share > 0, ball
    if plan.nested:
        inner_surface, radiance = _arrive(inner, path, radiance, setting, False)
        inner_goes = inner_goes & (inner_surface < plan.first_lamp)

    way, goes_on, surface = inner, inner_goes, inner_surface
    if plan.random:  # with one ball, whatever leaves it never comes back
        chance = jnp.where(inner_goes, jax.lax.stop_gradient(outer.share), 1.0)
        chance = jnp.where(outer_goes, chance, 0.0)
        go_out = setting.draw(path.bounces, 0) < chance
        way, goes_on, surface = choose(
            go_out, (outer, outer_goes, outer_surface), (inner, inner_goes, inner_surface)
        )
        way = way._replace(share=way.share / jnp.where(go_out, chance, 1.0 - chance))
    moved = path._replace(
        ray=way.ray,
        footprint=way.footprint,
        surface=surface,
        last=ball,
        throughput=(throughput * way.share,),
    )
    return _go_on(path, moved, goes_on, differ, radiance, setting)


def _arrive(
    way: Way, path: Path, radiance: Channels, setting: Setting, clear: bool
) -> tuple[Array, Channels]:
    """The surface that a way meets, and the radiance with what that one adds.

    Args:
        way: from the ball that the path is at.
        path: as it came there.
        radiance: of the path by then.
        setting: the rest.
        clear: whether the way is known to meet no glass.
    """
    plan, world = setting.plan, setting.tables.world
    spheres = all_spheres(world, plan, setting.one)
    surface = nearest(way.ray, world, plan, path.surface, spheres, way.footprint)
    arrived = path._replace(ray=way.ray, footprint=way.footprint)
    light = arriving(surface, arrived, setting.tables, plan, setting.one, clear)
    factor = path.throughput[0] * way.share
    factor = jnp.where(path.alive & (surface >= plan.first_lamp), factor, 0.0)
    return surface, tuple(r + factor * x for r, x in zip(radiance, light, strict=True))


def unentered(path: Path) -> Path:
    """The same, with room for a chord."""
    zero = jnp.zeros_like(path.ray.direction.x)
    two, four = (zero,) * 2, (zero,) * 4
    return path._replace(chord=Chord(zero, two, zero, zero, zero, four, four, zero, two))


def _enter(path: Path, setting: Setting) -> Path:
    """A path, with room for a chord, into the only ball, beside which there is no other glass."""
    ball = path.surface
    assert path.footprint is not None
    old, changes = path.ray.direction, tuple(edge.direction for edge in path.footprint)
    foot = _facing(path, setting, False)
    center, index = _pick_vector(setting.tables.world.centers, ball), setting.index_of(ball)

    stage = partial(_staged, setting.one)
    cos_i, tilts = stage(jnp.abs, foot.cosine, *foot.tilts)

    def entering(cos_i: Real) -> tuple[Real, ...]:
        """The cosine inside; of the normal and of the direction before, what is the one there."""
        cos_t = cos_transmitted(cos_i, index)
        slower, weight = refraction(cos_i, cos_t, index)
        return cos_t, weight, slower

    unit, zero = jnp.ones_like(cos_i), jnp.zeros_like(cos_i)
    (cos_t, weight, slower), ((bend, turn, _),) = stage(entering, cos_i, unit)
    share = once(lambda: fresnel_reflectance(cos_i, cos_t, index), setting.one)

    def mirrored(given: tuple[Vec3, Vec3, Real]) -> Vec3:
        old, outward, cos_i = given
        return old + outward * reflection(cos_i)[1]

    pushes = zip(changes, foot.turns, tilts, strict=True)
    outer, swings = stage(mirrored, (old, foot.outward, cos_i), *pushes)
    across, down = (Ray(move, swing) for move, swing in zip(foot.moves, swings, strict=True))
    way = Way(Ray(center + foot.offset, outer), (across, down), share)
    _, radiance = _arrive(way, path, path.radiance, setting, True)
    size, *swells = (vector.dot(foot.outward) for vector in (foot.offset, *foot.moves))
    chord = Chord(
        cos_i,
        tilts,
        cos_t,
        bend,
        share,
        (unit, zero, weight, slower + zero),
        (zero, zero, turn, zero),
        size,
        (swells[0], swells[1]),
    )
    turned, other = (Ray(turn, change) for turn, change in zip(foot.turns, changes, strict=True))
    moved = path._replace(
        ray=Ray(foot.outward, old),
        footprint=(turned, other),
        last=ball,
        throughput=(path.throughput[0] * (1.0 - share),),
        chord=chord,
    )
    return _go_on(path, moved, share < 1, jnp.ones(share.shape, bool), radiance, setting)


def _along_chord(path: Path, setting: Setting) -> Path:
    """A path inside the only ball to where it meets it next: what leaves there, and what stays."""
    ball, chord, edges = path.surface, path.chord, path.footprint
    assert chord is not None
    assert edges is not None
    center, index = _pick_vector(setting.tables.world.centers, ball), setting.index_of(ball)

    def onward(given: Any) -> tuple[Real, ...]:
        """The place there, and what of normal and direction at the entrance makes the way out."""
        inner, cosine, (a, b, r, s) = given
        twice, less = 2.0 * inner, cosine - index * inner
        a, b = a + twice * r, b + twice * s
        return a, b, r - twice * a, s - twice * b, index * r + less * a, index * s + less * b

    given = chord.inner, chord.cosine, chord.place
    in_cosine = chord.bend, jnp.ones_like(chord.cosine), chord.turns
    (a, b, r, s, *out), (turns,) = _staged(setting.one, onward, given, in_cosine)
    normal, direction = path.ray

    def leaving() -> tuple[Ray, tuple[Ray, ...]]:
        outward, left = (normal * x + direction * y for x, y in ((a, b), out))
        rates = [normal * x + direction * y for x, y in (turns[:2], turns[4:])]

        def pushed_out(edge: Ray, tilt: Real, swell: Real) -> Ray:
            turn, change = (
                edge.origin * x + edge.direction * y + rate * tilt
                for (x, y), rate in zip(((a, b), out), rates, strict=True)
            )
            return Ray(turn * chord.size + outward * swell, change)

        each = zip(edges, chord.tilts, chord.swells, strict=True)
        return Ray(center + outward * chord.size, left), tuple(pushed_out(*edge) for edge in each)

    ray, (across, down) = once(leaving, setting.one)
    way = Way(ray, (across, down), 1.0 - chord.share)
    _, radiance = _arrive(way, path, path.radiance, setting, True)
    moved = path._replace(
        throughput=(path.throughput[0] * chord.share,),
        chord=chord._replace(place=(a, b, r, s), turns=turns[:4]),
    )
    everywhere = jnp.ones(path.alive.shape, bool)
    return _go_on(path, moved, everywhere, everywhere, radiance, setting)


class Foot(NamedTuple):
    """Where a footprint meets a ball: each with its changes along both edges.

    Args:
        offset: from the ball's centre to there.
        moves: of the offset.
        outward: the normal.
        turns: of the normal.
        cosine: of the path's direction and the normal.
        tilts: of the cosine.
    """

    offset: Vec3
    moves: tuple[Vec3, ...]
    outward: Vec3
    turns: tuple[Vec3, ...]
    cosine: Real
    tilts: tuple[Real, ...]


def _facing(path: Path, setting: Setting, inside: Array | bool) -> Foot:
    """Where a path meets its ball.

    In stages, each computed once: in one, the fusing compiler would compute the whole again for
    each of the footprint's numbers.
    """
    plan, world, ball = setting.plan, setting.tables.world, path.surface
    center, radius = _pick_vector(world.centers, ball), _pick(world.radii, ball)
    assert path.footprint is not None

    stage = partial(_staged, setting.one)
    old, changes = path.ray.direction, tuple(edge.direction for edge in path.footprint)
    if plan.soft:
        width = box_width(sphere_depth(path.ray, path.footprint, center, radius)[2])
        offset, moves = stage(
            lambda ray: soft_offset(ray, center, radius, width, inside), path.ray, *path.footprint
        )
        outward, turns = stage(normalize, offset, *moves)
    else:
        distance, gains = stage(
            lambda ray: _distance_to_ball(ray, center, radius, plan, inside),
            path.ray,
            *path.footprint,
        )
        outward, turns = stage(
            lambda met: normalize(met[0].origin + met[0].direction * met[1] - center),
            (path.ray, distance),
            *zip(path.footprint, gains, strict=True),
        )
        offset, moves = outward * radius, tuple(turn * radius for turn in turns)
    both_turn = tuple(zip(changes, turns, strict=True))
    cosine, tilts = stage(lambda vectors: vectors[0].dot(vectors[1]), (old, outward), *both_turn)
    return Foot(offset, moves, outward, turns, cosine, tilts)


def _parting(path: Path, setting: Setting) -> tuple[Way, Way, Array]:
    """The outer and the inner way from a glass surface, and whether it is an interface."""
    plan, world, ball = setting.plan, setting.tables.world, path.surface
    center, radius = _pick_vector(world.centers, ball), _pick(world.radii, ball)
    assert path.footprint is not None
    old, changes = path.ray.direction, tuple(edge.direction for edge in path.footprint)
    inside = path.last == ball
    offset, moves, outward, turns, cosine, tilts = _facing(path, setting, inside)
    stage = partial(_staged, setting.one)
    # A border within glass, or a camera there, shows its side only here.
    leaves = cosine > 0 if plan.nested else inside
    on_ball = center + outward * radius
    media = surface_indices(on_ball, outward, ball, setting.index_of, world, plan)

    def weights(cosine: Real) -> tuple[Real, ...]:
        """Of the outward normal in the mirrored direction, and in the bent one."""
        cos_i = jnp.abs(cosine)
        glass = glass_interface(media, cos_i, leaves)
        against = reflection(cos_i)[1], refraction(cos_i, glass.cos_t, glass.eta)[1]
        return tuple(choose(leaves, -weight, weight) for weight in against)

    def light() -> tuple[Real, Real, Array]:
        """The outer way's share, the old direction's weight in the bent one, if they differ."""
        glass = glass_interface(media, jnp.abs(cosine), leaves)
        share = choose(leaves, 1.0 - glass.reflectance, glass.reflectance)
        return share, inverse(glass.eta), glass.differ

    both_weights, weighed = stage(weights, cosine, *tilts)
    share, slower, differ = once(light, setting.one)

    def directions(given: tuple[Vec3, Vec3, tuple[Real, ...]]) -> tuple[Vec3, Vec3]:
        old, outward, (mirror, bend) = given
        mirrored, bent = old + outward * mirror, old * slower + outward * bend
        return choose(leaves, bent, mirrored), choose(leaves, mirrored, bent)

    given, pushes = (old, outward, both_weights), zip(changes, turns, weighed, strict=True)
    (outer, inner), (across, down) = stage(directions, given, *pushes)
    point = center + offset

    def way(direction: Vec3, number: int, share: Real) -> Way:
        footprint = Ray(moves[0], across[number]), Ray(moves[1], down[number])
        return Way(Ray(point, direction), footprint, share)

    return way(outer, 0, share), way(inner, 1, 1.0 - share), differ


def _go_on(
    path: Path, moved: Path, goes_on: Array, differ: Array, radiance: Channels, setting: Setting
) -> Path:
    """The moved path, ended unless it goes on.

    Where derivatives may be asked for an ended path is the old one, whose numbers are finite. Else
    nobody reads them: only tables are looked up with them, within their bounds.
    """
    bounces = path.bounces + jnp.where(differ, 1, 0)
    # Colours have negative parts where a wavelength is outside what a screen can show.
    brightest = reduce(jnp.maximum, map(jnp.abs, moved.throughput))
    # A path of b bounces has b + 1 segments, and the light that it adds next came over one more.
    alive = path.alive & goes_on & (brightest > setting.cutoff)
    alive = alive & (bounces < setting.plan.depth - 1)
    kept = moved._replace(bounces=bounces)
    if setting.differentiable:
        kept = choose(alive, kept, path)
    return kept._replace(
        radiance=radiance,
        alive=alive,
        spectral=moved.spectral,
        reflected=moved.reflected,
        choices=moved.choices,
        lit=moved.lit,
    )


def _distance_to_ball(
    ray: Ray, center: Vec3, radius: Real, plan: Plan, inside: Array | bool
) -> Real:
    """Distance to the ball that the path is known to meet next."""
    across = -2.0 * (ray.origin - center).dot(ray.direction)
    near, far, _ = sphere_distances(ray, center, radius)
    ahead = jnp.where(near > 0, near, far) if plan.nested else near
    return choose(inside, across, ahead)


class Scattered(NamedTuple):
    """Where a path goes from the surface that it met, and what it is lit by there.

    Args:
        ray: the way it goes.
        throughput: of the path from now on.
        goes_on: whether any light goes that way.
        differ: whether there was a surface at all: between equal media there is none.
        matte: whether the surface is matte.
        spectral: whether dispersive glass has been met.
        reflected: as in `Path`.
        choices: as in `Path`.
        share: of the light at glass that goes the chosen way, over the chance of that; None where
            no derivatives are asked for, or no glass is there.
        density: of the chosen direction, in solid angle, where matte; None, as the others, where
            no lamps are aimed at.
        lamp: number of the lamp that the ray `to_lamp` aims at.
        to_lamp: a ray to a point of that lamp.
        lamp_share: what the lamp's radiance counts if it is seen.
        lamp_total: density of lamp directions, for a unit of luminance.
    """

    ray: Ray
    throughput: Channels
    goes_on: Array
    differ: Array
    matte: Array
    spectral: Array | None
    reflected: Real | None
    choices: Choices | None
    share: Real | None
    density: Real | None = None
    lamp: Array | None = None
    to_lamp: Ray | None = None
    lamp_share: Real | None = None
    lamp_total: Real | None = None


def _one_way(path: Path, setting: Setting) -> Path:
    """A bounce in a scene with matte or metal surfaces: one way, chosen at once."""
    plan, tables = setting.plan, setting.tables
    footprint: tuple[Ray, Ray] | None = None
    if path.footprint is None:
        scattered = _scatter(path, setting)
    else:
        scattered, footprint = _scattered_footprint(path, setting)
    moved = path._replace(
        ray=scattered.ray,
        footprint=footprint,
        last=path.surface,
        throughput=scattered.throughput,
        spectral=scattered.spectral,
        reflected=scattered.reflected,
        choices=scattered.choices,
    )
    radiance, counts = path.radiance, path.alive
    if setting.always is not None:
        assert scattered.spectral is not None
        counts = counts & (setting.always | scattered.spectral)
    if plan.lit:
        shown = _lamplight(path, counts, scattered, setting)
        radiance = tuple(r + x for r, x in zip(radiance, shown, strict=True))
    spheres = all_spheres(tables.world, plan, setting.one)
    if plan.filtered and scattered.share is not None:
        radiance = _against_chance(radiance, counts, path.throughput, scattered.share, tables, plan)
    if path.lit is not None:
        assert path.footprint is not None
        first = scattered.matte & ~_all_zero(path.footprint) & path.alive
        here = Lit(
            scattered.throughput,
            radiance,
            path.surface,
            path.ray,
            path.footprint,
            path.last,
            path.bounces,
        )
        moved = moved._replace(lit=choose(first, here, path.lit))
    if footprint is None:
        surface = nearest(moved.ray, tables.world, plan, path.surface, spheres)
    else:
        assert moved.choices is not None
        surface, share, choices = _one_of_seen(
            moved.ray, footprint, path.surface, moved.choices, spheres, tables.world, plan
        )
        radiance = _against_chance(radiance, counts, moved.throughput, share, tables, plan)
        throughput = tuple(t * share for t in moved.throughput)
        moved = moved._replace(throughput=throughput, choices=choices)
    light = emitted(surface, moved, tables, plan, setting.one)
    arrives = counts & scattered.goes_on & (surface >= plan.first_lamp)
    factor = jnp.where(arrives, 1.0, 0.0)
    if plan.lit:
        factor = factor * _chance_weight(surface, scattered, tables, plan)
    radiance = tuple(
        r + jnp.where(arrives, t * factor * x, 0.0)
        for r, t, x in zip(radiance, moved.throughput, light, strict=True)
    )
    goes_on = scattered.goes_on & (surface < plan.first_lamp)
    return _go_on(
        path, moved._replace(surface=surface), goes_on, scattered.differ, radiance, setting
    )


FILTERED_BOUNCES = 5
"""Bounces after which a path has no footprint any more. What a ball has reflected four times is
faint; but where such an image turns back, as in a rainbow, footprints are so narrow that a border
within one counts more than all other paths of a pixel. Measured with 256 samples and six seeds on a
ball over a chequered plane from above: 0.036 off in the mean; with three of the seeds 0.030 to
0.041, where 8 bounces were 0.042 to 0.057 off and any number 0.057 to 0.078."""


def _scattered_footprint(path: Path, setting: Setting) -> tuple[Scattered, tuple[Ray, Ray]]:
    """What a surface does to the path that meets it, and to its footprint.

    What scatters ends the footprint, and so do many bounces.
    """

    def of(ray: Ray) -> tuple[Ray, Scattered]:
        scattered = _scatter(path._replace(ray=ray), setting)
        return scattered.ray, scattered

    assert path.footprint is not None
    _, push, scattered = jax.linearize(of, path.ray, has_aux=True)
    spread = scattered.matte
    if setting.plan.fuzzy:
        spread = path.surface >= setting.plan.balls
    ends = spread | (path.bounces >= FILTERED_BOUNCES)
    none = jax.tree.map(jnp.zeros_like, path.ray)
    across, down = (choose(ends, none, push(edge)) for edge in path.footprint)
    return scattered, (across, down)


def _one_of_seen(
    ray: Ray,
    footprint: tuple[Ray, Ray],
    last: Array,
    choices: Choices,
    spheres: Candidates,
    world: World,
    plan: Plan,
) -> tuple[Array, Real, Choices]:
    """One of the surfaces that a footprint meets, what it counts, and the choices with this one.

    Across an outline, and the horizon of a plane, lie two: the nearer one is chosen by the part of
    the footprint that meets it. The part has a derivative, the chance has none. A ball of glass is
    met by all of it or none, also where outlines are soft.

    Args:
        ray: the footprint's middle.
        footprint: its edges.
        last: number of the surface that it leaves.
        choices: that have been made.
        spheres: those that it can meet.
        world: the scene.
        plan: its static choices.
    """
    first = nearest(ray, world, plan, last, spheres, footprint)
    part = _part_met(first, ray, footprint, world, plan)
    # A small part changes by much of itself: it is chosen more often than it is large.
    certain = jax.lax.stop_gradient(part)
    chance = jnp.where(certain > 0, 0.5 * (1.0 + certain), 0.0)
    taken, made = choices.made(chance)
    choices = choose(_all_zero(footprint), choices, made)
    behind = nearest(ray, world, plan, last, spheres, None, first)
    share = jnp.where(taken, part, 1.0 - part)
    counted = jnp.where(taken, chance, 1.0 - chance)
    share = share / jnp.where(counted > 0, counted, 1.0)
    return jnp.where(taken, first, behind), share, choices


def _against_chance(
    radiance: Channels,
    counts: Array,
    throughput: Channels,
    share: Real,
    tables: Tables,
    plan: Plan,
) -> Channels:
    """The same radiance, with a derivative of less noise.

    Of ways that are chosen by chance, the derivatives of what each counts are 0 in the mean. Times
    the background's radiance, near to what is seen on one of them, they take most of the noise out.
    """
    background = plan.background - plan.balls + tables.first_row
    change = jnp.where(counts, share - jax.lax.stop_gradient(share), 0.0)
    return tuple(
        r - change * jax.lax.stop_gradient(t * _pick(mean, background))
        for r, t, mean in zip(radiance, throughput, tables.paint.mean, strict=True)
    )


def _part_met(
    surface: Array, ray: Ray, footprint: tuple[Ray, Ray], world: World, plan: Plan
) -> Real:
    """Part of a footprint that meets a surface, were there nothing before it; 1 for balls."""
    outlined, depth, edges = _outline_met(surface, ray, footprint, world, plan)
    return jnp.where(outlined & ~_all_zero(footprint), covered(depth, *edges), 1.0)


def _outline_met(
    surface: Array, ray: Ray, footprint: tuple[Ray, Ray], world: World, plan: Plan
) -> tuple[Array, Real, tuple[Real, Real]]:
    """How far within the outline of a surface a footprint lies.

    Returns:
        Whether the surface has one: no ball of glass, nor what surrounds the ray. Of a sphere its
        `sphere_depth`, of a plane the cosine to it, both below 0 beyond the outline. And the
        changes of that along both edges.
    """
    depth: Real = jnp.ones_like(ray.direction.x)
    edges: tuple[Real, Real] = (0.0 * depth, 0.0 * depth)
    outlined: Array = jnp.zeros(surface.shape, bool)
    if plan.spheres > plan.balls:
        row, is_sphere = _sphere_row(surface, plan)
        center, radius = _pick_vector(world.centers, row), _pick(world.radii, row)
        _, depth, edges = sphere_depth(ray, footprint, center, radius)
        outside = _starts_outside(ray, center, radius)
        outlined = jnp.asarray(is_sphere & (surface >= plan.balls) & outside)
    if plan.planes:
        plane = _plane_row(surface, plan)
        normal = _pick_vector(world.normals, plane)
        height = (ray.origin - _pick_vector(world.points, plane)).dot(normal)
        side = jnp.where(height < 0, 1.0, -1.0)
        across, down = (edge.direction.dot(normal) * side for edge in footprint)
        cosine = ray.direction.dot(normal) * side
        matte = (surface >= plan.first_plane) & (surface < plan.first_lamp)
        screen = (surface >= plan.first_lamp + plan.lamps) & (surface < plan.background)
        flat = matte | screen
        depth, edges = choose(flat, (cosine, (across, down)), (depth, edges))
        outlined = outlined | flat
    return outlined, depth, edges


def _starts_outside(ray: Ray, center: Vec3, radius: Real) -> Array:
    """Whether a ray starts outside a sphere, and not on it or within rounding of that."""
    offset = ray.origin - center
    return jnp.asarray(offset.dot(offset) > radius * radius * (1.0 + 1e-5))


def _all_zero(footprint: tuple[Ray, Ray]) -> Array:
    """Whether a footprint is a point."""
    return reduce(jnp.logical_and, (leaf == 0 for leaf in jax.tree.leaves(footprint)))


def _scatter(path: Path, setting: Setting) -> Scattered:
    """What the surface that a path meets does to it."""
    (world, *_), plan, surface = setting.tables, setting.plan, path.surface
    old = path.ray.direction
    first_matte, after_matte = plan.mattes
    is_matte = (surface >= first_matte) & (surface < after_matte)
    is_glass = surface < plan.balls
    count = 3 if plan.fuzzy else min(plan.numbers_per_bounce, 2)
    drawn = once(lambda: [setting.draw(path.bounces, k) for k in range(count)], setting.one)

    point, outward, cosine = _meet(path, setting)
    leaves, cos_i = cosine > 0, jnp.abs(cosine)
    facing = choose(leaves, -outward, outward)

    ball = jnp.minimum(surface, plan.balls - 1)
    media = None
    if plan.balls:
        media = once(
            lambda: surface_indices(point, outward, ball, setting.index_of, world, plan),
            setting.one,
        )

    def ways() -> tuple[Mix, Vec3 | None, Array, Channels | None, Real | None, Choices | None]:
        """How the new direction is mixed, of what, whether there is a surface, what goes there.

        And what a reflected path counts that is to follow this one.
        """
        choices = path.choices
        unit, shares, zero, reflected = None, None, jnp.zeros_like(cosine), path.reflected
        mix, differ = Mix(*reflection(cos_i), zero), jnp.ones(cosine.shape, bool)
        if plan.numbers_per_bounce > 1:
            unit = uniform_direction(drawn[0], drawn[1])
        if plan.fuzzy:
            metal = jnp.where(surface < first_matte, surface, surface - after_matte + first_matte)
            fuzz = _pick(world.fuzz, jnp.clip(metal - plan.balls, 0, plan.metals - 1))
            # The radius of a uniform point of the unit ball: the cube root, by its logarithm.
            radius = jnp.exp(jnp.log(jnp.maximum(drawn[2], 1e-12)) * (1.0 / 3.0))
            mix = mix._replace(unit=radius * fuzz)
        if after_matte > first_matte:
            mix = choose(is_matte, Mix(zero, zero + 1.0, zero + 1.0), mix)
        if media is not None:
            glass, angle = glass_interface(media, cos_i, leaves), cos_i
            chance = jax.lax.stop_gradient(glass.reflectance)
            if plan.filtered:
                assert path.footprint is not None
                spread = _all_zero(path.footprint)
                outer = jnp.where(leaves, glass.cos_t, cos_i)
                still = spread & (outer < GRAZING)
                glass, angle = choose(still, jax.lax.stop_gradient((glass, angle)), (glass, angle))
                # Once scattered, paths that all count alike leave no noise of what is reflected
                # but by what is seen otherwise than the background: see `_against_chance`.
                followed = leaves & ~spread & (chance > 0)
                chance = jnp.where(followed, jnp.maximum(chance, STAYING), chance)
            mirrored: Array = drawn[0] < chance
            if choices is not None:
                chosen, made = choices.made(chance)
                seen = is_glass & ~spread
                mirrored = jnp.where(seen, chosen, mirrored)
                choices = choose(seen, made, choices)
            if setting.split is not None:
                assert reflected is not None
                mirrored, shares, reflected = _parted(
                    mirrored, glass, cos_i, leaves, setting.split, reflected, drawn[0]
                )
            elif setting.differentiable:
                share = jnp.where(mirrored, glass.reflectance, 1.0 - glass.reflectance)
                counted = jnp.where(mirrored, chance, 1.0 - chance)
                share = jnp.where(is_glass & (counted > 0), share, 1.0)
                shares = (
                    share / jnp.where(is_glass & (counted > 0), counted, 1.0),
                ) * plan.channels
            bent = Mix(*refraction(angle, glass.cos_t, glass.eta), zero)
            through = choose(mirrored, Mix(*reflection(angle), zero), bent)
            mix = choose(is_glass, through, mix)
            differ = jnp.asarray(glass.differ | ~is_glass)
        return mix, unit, differ, shares, reflected, choices

    mix, unit, differ, shares, reflected, choices = once(ways, setting.one)

    def mixed() -> Vec3:
        """The new direction, of any length."""
        direction = old * mix.old + facing * mix.facing
        return direction if unit is None else direction + unit * mix.unit

    raw = once(mixed, setting.one)

    def finished() -> Scattered:
        squared = raw.dot(raw)
        # A matte or fuzzy direction may vanish, as it does once in a million.
        vanishes = squared < 1e-12
        scale = inverse_root(jnp.where(vanishes, 1.0, squared))
        direction = choose(vanishes, facing, raw * scale)
        goes_on = jnp.ones(cosine.shape, bool)
        if plan.fuzzy:
            goes_on = is_matte | is_glass | (direction.dot(facing) > 0)
        sunk = _beneath(point, outward, surface, setting.tables, plan)
        albedo = painted(
            surface, path, lambda at: at, sunk, None, setting.tables, plan, False, setting.one
        )
        if path.footprint is not None:
            albedo = _albedo_for_now(path, is_matte, albedo, setting)
        throughput = tuple(
            t * jnp.where(is_glass, 1.0, a) for t, a in zip(path.throughput, albedo, strict=True)
        )
        if shares is not None:
            throughput = tuple(t * share for t, share in zip(throughput, shares, strict=True))
        spectral = path.spectral
        if spectral is not None:
            disperses = is_glass
            if setting.split is not None:
                disperses = is_glass & ~(setting.split.now & setting.split.reflects)
            now = disperses & ~spectral
            spectral = spectral | disperses
            if setting.weights is not None:
                throughput = tuple(
                    t * jnp.where(now, w, 1.0)
                    for t, w in zip(throughput, setting.weights, strict=True)
                )
        ray, share = Ray(point, direction), shares[0] if setting.differentiable and shares else None
        return Scattered(
            ray, throughput, goes_on, differ, is_matte, spectral, reflected, choices, share
        )

    scattered = once(finished, setting.one)
    return (
        _aim(scattered, facing, partial(setting.draw, path.bounces), setting)
        if plan.lit
        else scattered
    )


ASIDE, UPWARD = 4, 8
"""Along and towards an outline: so many parts of a footprint on what scatters are met exactly. Far
away, and at an outline, a footprint is far from straight there. Measured with 256 samples on a ball
over a chequered globe, over a plane from above and over one with its horizon: 0.035, 0.036 and
0.047 off; where the parts' rays are not exact 0.036, 0.043 and 0.048; with 4 by 4 parts 0.040,
0.036 and 0.051. With as few as half of the footprints for a pixel the last would be 0.039, but the
outline of the ball, which is hard, has the fewer points."""

SHIFTS = 0.7548776662466927, 0.5698402909980532
"""From one of the paths that share a footprint to the next, of the borders between its parts. What
parts on both sides of a border do not agree about is different with each, and goes out in the mean:
near a plane's horizon seen through a ball that was more than all else.

Source:
    Roberts, The Unreasonable Effectiveness of Quasirandom Sequences (2018): one over the root of
    x³ = x + 1, and over its square.
"""


def _albedo_for_now(path: Path, is_matte: Array, at_point: Channels, setting: Setting) -> Channels:
    """What part of the light a surface sends on, to a path with a footprint.

    Where one scatters first it is the texture's mean, until the path has ended: then once for all
    by `_mean_albedo`, which takes as long as several bounces.

    Args:
        path: the path.
        is_matte: whether the surface is.
        at_point: what it is to a path without footprint.
        setting: the rest.
    """
    assert path.footprint is not None
    plan, tables = setting.plan, setting.tables
    pointed, albedo = _all_zero(path.footprint), at_point
    if plan.metals:
        albedo = choose(pointed, at_point, _painted_at(path, setting))
    return choose(is_matte & ~pointed, _mean_color(path.surface, tables, plan), albedo)


def _mean_color(surface: Array, tables: Tables, plan: Plan) -> Channels:
    """The mean of a texture, of a surface that is no glass."""
    row = jnp.maximum(surface - plan.balls, 0) + tables.first_row
    return tuple(_pick(mean, row) for mean in tables.paint.mean)


def _painted_at(path: Path, setting: Setting, stiff: bool = False) -> Channels:
    """The mean of a texture over the path's footprint.

    Args:
        path: the path.
        setting: the rest.
        stiff: whether the derivative knows how the footprint moves alone, not how it grows. What a
            border of tiles that moves counts is even over a part of the film, however unevenly that
            part lies on the surface.
    """
    plan, tables, surface = setting.plan, setting.tables, path.surface

    def beneath(ray: Ray) -> Vec3:
        point, outward, _ = _meet(path._replace(ray=ray), setting)
        return _beneath(point, outward, surface, tables, plan)

    def carried(ray: Ray) -> Vec3:
        return beneath(ray) + (here - jax.lax.stop_gradient(here))

    met, edges = path.ray, path.footprint
    if not stiff:
        return painted(surface, path, beneath, met, edges, tables, plan, False, setting.one)
    here = beneath(met)
    met, edges = jax.lax.stop_gradient((met, edges))
    return painted(surface, path, carried, met, edges, tables, plan, False, setting.one)


def through_ball(
    ray: Ray, center: Vec3, radius: Real, index: Real, met: Array
) -> tuple[Ray, Array]:
    """What a ball of glass in air makes of a ray, and whether the ray meets it from outside.

    It stays in the plane through the ball's centre, and passes that as far away as before. All
    that is told by cosines and by sines over that distance, so that nothing is divided by it.

    Args:
        ray: a ray.
        center: of the ball.
        radius: of the ball.
        index: of the ball.
        met: how often the ray meets its surface, from 1 to `FILTERED_BOUNCES`: once where it is
            reflected, else it leaves at the last.

    Source:
        van de Hulst, Light Scattering by Small Particles (1957), section 12.2: the deflection.
    """
    offset, direction = (ray.origin - center) * inverse(radius), ray.direction
    along = offset.dot(direction)
    foot = offset - direction * along
    sine = foot.dot(foot)  # squared, of the angle of incidence
    meets = (along < 0) & (sine < jnp.minimum(1.0, index * index)) & (offset.dot(offset) > 1)
    foot = choose(meets, foot, jax.tree.map(jnp.zeros_like, foot))
    sine = jnp.where(meets, sine, 0.0)
    cosine, within = safe_sqrt(1.0 - sine), sine * inverse(index * index)
    cosine_within = safe_sqrt(1.0 - within)
    turn, bend = 2.0 * sine - 1.0, -2.0 * cosine
    # Each further surface turns it by π less twice the angle of refraction.
    more, bent = 2.0 * within - 1.0, 2.0 * cosine_within * inverse(index)
    for number in range(2, FILTERED_BOUNCES + 1):
        further = turn * more - sine * bend * bent, bend * more + turn * bent
        turn, bend = choose(met >= number, further, (turn, bend))
    turned = direction * turn - foot * bend
    place = foot * turn + direction * (sine * bend) + turned * cosine
    return Ray(center + place * radius, turned), meets


def _sent_through(
    path: Path, start: Path, place: tuple[Real, Real], setting: Setting
) -> tuple[Ray, Array]:
    """The ray of a place within a footprint, after it has met one ball of glass or none.

    Args:
        path: after that.
        start: the same at the camera.
        place: to the right of and below the footprint's middle, in its edges.
        setting: the rest.

    Returns:
        The ray, and whether it does so.
    """
    assert start.footprint is not None
    assert path.lit is not None
    world, plan, met = setting.tables.world, setting.plan, path.lit.met
    (x, y), (across, down) = place, start.footprint
    by_x, by_y = start.stretch or (0.0 * x, 0.0 * y)
    ahead = start.ray.direction * (1.0 + x * by_x + y * by_y)
    ray = Ray(start.ray.origin, normalize(ahead + across.direction * x + down.direction * y))
    if not plan.balls:
        return ray, met == 0
    ball = jnp.clip(path.last, 0, plan.balls - 1)
    center, radius = _pick_vector(world.centers, ball), _pick(world.radii, ball)
    left, meets = through_ball(ray, center, radius, setting.index_of(ball), met)
    return choose(met == 0, ray, left), (met == 0) | meets


def _nearly(ray: Ray, other: Ray) -> Array:
    """Whether two rays are the same but for rounding, which near a ball's rim is 1e-4."""
    turned, away = ray.direction - other.direction, ray.origin - other.origin
    far = ray.origin.dot(ray.origin) + other.origin.dot(other.origin)
    return jnp.asarray((turned.dot(turned) < 1e-6) & (away.dot(away) <= 1e-6 * far))


def _mean_albedo(path: Path, start: Path, shift: tuple[Real, Real], setting: Setting) -> Channels:
    """What part of the light a surface that scatters sends on, its mean over a footprint.

    Towards the outline of a sphere a footprint reaches ever further over it, as the root of the
    depth to which a line goes into the sphere, and on a plane still faster. So the parts are even
    in that root: there each is as straight as the others. What lies beyond does not count.

    Rays of the parts are exact where the path has met one ball at most; elsewhere they change along
    the footprint as its middle does.

    Args:
        path: on its way to the surface.
        start: the same at the camera.
        shift: where the borders between parts lie, aside and upward, from 0 to 1.
        setting: the rest.
    """
    assert path.footprint is not None
    plan, tables = setting.plan, setting.tables
    means, one = _mean_color(path.surface, tables, plan), jnp.ones_like(path.ray.origin.x)
    outlined, *met = _outline_met(path.surface, path.ray, path.footprint, tables.world, plan)
    depth, changes = choose(outlined, tuple(met), (one, (0.0 * one, 0.0 * one)))
    # Without tiles there is no stretch, and what stands in its place is not looked at.
    units = (one, 0.0 * one), (0.0 * one, one)
    edges = tuple(zip(path.footprint, path.stretch or changes, changes, units, strict=True))
    swap = jnp.abs(changes[0]) > jnp.abs(changes[1])
    upward, aside = choose(swap, edges, edges[::-1])
    upward = jax.tree.map(lambda leaf: jnp.where(upward[2] < 0, -leaf, leaf), upward)
    rise = jnp.where(upward[2] > 0, upward[2], 1.0)

    def exact(place: tuple[Real, Real]) -> tuple[Ray, Array]:
        return _sent_through(path, start, place, setting)

    known = _nearly(exact((0.0 * one, 0.0 * one))[0], path.ray)

    def part(aside_at: tuple[Real, Real], upward_at: tuple[Real, Real]) -> tuple[Real, Channels]:
        """The size of a part, and what it sends on; of where it begins and ends, from 0 to 1."""
        across, wide = 0.5 * (aside_at[0] + aside_at[1]) - 0.5, aside_at[1] - aside_at[0]
        middle = depth + across * aside[2]
        low, high = middle - 0.5 * upward[2], middle + 0.5 * upward[2]
        meets = jnp.where(low < 0, jnp.clip(high / rise, 0.0, 1.0), 1.0)
        # Where one part ends and the next begins may stay: only the outline moves.
        low, high, still = jax.lax.stop_gradient((low, high, meets))
        near, far = jnp.sqrt(jnp.maximum(low, 0.0)), jnp.sqrt(jnp.maximum(high, 0.0))
        both = jnp.where(near + far > 0, near + far, 1.0)
        begin, end = (still * x * (2.0 * near + (far - near) * x) / both for x in upward_at)
        length, place = end - begin, 0.5 - still + 0.5 * (begin + end)

        def at(middle: Any, aside: Any, upward: Any) -> Any:
            return jax.tree.map(lambda m, a, u: m + across * a + place * u, middle, aside, upward)

        narrow = jax.tree.map(lambda a: a * wide, aside)
        short = jax.tree.map(lambda u: u * length, upward)
        straight = at(path.ray, aside[0], upward[0]), (narrow[0], short[0])
        film = at((0.0, 0.0), aside[3], upward[3])
        ray, push, possible = jax.linearize(exact, film, has_aux=True)
        bent = ray, (push(narrow[3]), push(short[3]))
        ray, footprint = choose(known & possible, bent, straight)
        seen = path._replace(ray=ray, footprint=footprint)
        if path.stretch is not None:
            seen = seen._replace(stretch=(narrow[1], short[1]))
        shown = _painted_at(seen, setting, stiff=True)
        return wide * (length + jnp.where(upward_at[0] == 0, meets - still, 0.0)), shown

    sides = [_limits(count, by) for count, by in zip((ASIDE, UPWARD), shift, strict=True)]
    both_ways = [jnp.meshgrid(*ends) for ends in zip(*sides, strict=True)]
    begins, ends = ([grid.ravel() for grid in grids] for grids in both_ways)
    sizes, shown = jax.vmap(part)(*zip(begins, ends, strict=True))
    total = jnp.sum(sizes)
    share = sizes / jnp.where(total > 0, total, 1.0)
    mixed = (jnp.sum(share * channel, axis=0) for channel in shown)
    return tuple(jnp.where(total > 0, m, mean) for m, mean in zip(mixed, means, strict=True))


def _limits(count: int, shift: Real) -> tuple[Array, Array]:
    """Where each of so many parts of a unit begins and ends, the borders between them shifted."""
    inner = (np.arange(1, count) - 0.5).astype(shift.dtype) + shift
    ends = jnp.pad(inner * (1.0 / count), 1, constant_values=(0.0, 1.0))
    return ends[:-1], ends[1:]


def _shown(path: Path, start: Path, shift: tuple[Real, Real], setting: Setting) -> Path:
    """A path that has ended, with what it counts where it scattered first.

    What it brought from there has been weighed by the texture's mean. Arguments are those of
    `_mean_albedo`.
    """
    lit, plan = path.lit, setting.plan
    assert lit is not None
    surface = jnp.maximum(lit.surface, plan.balls)
    there = path._replace(ray=lit.ray, footprint=lit.footprint, surface=surface, last=lit.last)
    means = _mean_color(surface, setting.tables, plan)
    radiance, throughput = [], []
    for channel, (mean, albedo) in enumerate(
        zip(means, _mean_albedo(there, start, shift, setting), strict=True)
    ):
        some = (lit.surface >= 0) & (mean != 0)
        ratio = jnp.where(some, albedo / jnp.where(some, mean, 1.0), 1.0)
        before = lit.before[channel]
        after = jnp.where(some, path.radiance[channel] - before, 0.0)
        radiance.append(path.radiance[channel] + after * (ratio - 1.0))
        throughput.append(lit.throughput[channel] * ratio)
    return path._replace(radiance=tuple(radiance), lit=lit._replace(throughput=tuple(throughput)))


STAYING = 0.4
"""Least chance of a reflection within a ball that the camera sees, where derivatives are wanted of
what scatters: such images move the faster with the index the longer light stays. Measured on a ball
over a matte ground, means of six: 0.13 off by the square root of the reflectance over the sum with
that of the rest, 0.12 by this, 0.125 by 0.5."""

GRAZING = 0.1
"""Cosine outside a ball below which scattered light has no derivative by its angle to the glass.
That grows as one over the cosine, so that its variance has no bound, while ever less light comes so
flat. Measured as above, means of eight: 0.124 off, and without 0.139, by a few single paths."""

FOLLOWED = 4.0
"""How much more often a reflected path is followed than light goes its way: noise against time."""


def _parted(
    mirrored: Array,
    glass: Interface,
    cos_i: Real,
    leaves: Array,
    split: Split,
    reflected: Real,
    u: Real,
) -> tuple[Array, Channels, Real]:
    """Whether a path is reflected, its share of the light, and what one counts that is to be.

    Args:
        mirrored: whether it is where the ways do not part.
        glass: the surface.
        cos_i: cosine of the angle of incidence.
        leaves: whether the ray leaves the ball.
        split: how the ways part.
        reflected: of the path until now.
        u: a number in [0, 1).
    """
    shares = []
    for ratio in split.ratios:
        eta = glass.eta * choose(leaves, 1.0 / ratio, ratio)
        reflectance = fresnel_reflectance(cos_i, cos_transmitted(cos_i, eta), eta)
        reflectance = jnp.where(glass.differ, reflectance, 0.0) * reflected
        share = jnp.where(split.reflects, reflectance, 1.0 - glass.reflectance)
        shares.append(jnp.where(split.now, share, 1.0))
    chance = jnp.minimum(FOLLOWED * glass.reflectance, 1.0)
    counts = jnp.where(u < chance, 1.0 / jnp.where(chance > 0, chance, 1.0), 0.0)
    parts = split.now & ~split.reflects
    return (
        jnp.where(split.now, split.reflects, mirrored),
        tuple(shares),
        jnp.where(parts, counts, reflected),
    )


class Mix(NamedTuple):
    """A new direction: so much of the old one, of the normal against it, of a random unit vector.

    A mirror direction is d + 2 cos θ n; a refracted one is d/η + (cos θ/η - cos θ') n; one that is
    spread by the cosine is n + u (Shirley and Morley, Realistic Ray Tracing (2003), section 9.4).
    """

    old: Real
    facing: Real
    unit: Real


def _meet(path: Path, setting: Setting) -> tuple[Vec3, Vec3, Real]:
    """Where a path meets its surface, the normal there, and the path's cosine to it.

    The normal of a sphere is the outward one.
    """
    (world, *_), plan, ray, surface = setting.tables, setting.plan, path.ray, path.surface
    rows, begins = plan.first_plane, path.last == surface

    def to_sphere() -> tuple[Vec3, Real, Real]:
        row = jnp.minimum(surface, rows - 1)
        center, radius = _pick_vector(world.centers, row), _pick(world.radii, row)
        distance, _ = _sphere_ahead(ray, center, radius, radius * radius, begins, plan)
        return center, radius, distance

    sphere = once(to_sphere, setting.one) if rows else None

    def to_outline() -> tuple[Array, Vec3]:
        """Whether a ball's outline is soft, and the offset from its centre."""
        assert sphere is not None
        assert path.footprint is not None
        center, radius, _ = sphere
        outside = _starts_outside(ray, center, radius)
        is_soft = (surface < plan.balls) & (begins | outside) & ~_all_zero(path.footprint)
        width = box_width(sphere_depth(ray, path.footprint, center, radius)[2])
        # It holds for a whole footprint, and moves next to not at all.
        width = jax.lax.stop_gradient(width)
        return is_soft, soft_offset(ray, center, radius, width, begins)

    outline = once(to_outline, setting.one) if plan.balls and plan.soft else None

    def meeting() -> tuple[Vec3, Vec3, Real]:
        if sphere is not None:
            center, radius, distance = sphere
            point = ray.origin + ray.direction * distance
            outward = normalize(point - center)
            # Back onto the sphere: in float32 the ray ends some way off a large one. By a fine
            # distance it does not, and so near it is nearer to the sphere than numbers from there.
            back = center + outward * radius
            point = choose(distance < radius, point, back) if plan.fine else back
            if outline is not None:
                is_soft, offset = outline
                soft = center + offset, normalize(offset)
                point, outward = choose(is_soft, soft, (point, outward))
        if plan.matte_planes + plan.metal_planes:
            plane, on_plane = _plane_row(surface, plan), surface >= rows
            normal = _pick_vector(world.normals, plane)
            to_plane = _to_plane(ray, plane, on_plane, world)
            if plan.filtered:  # a footprint may meet what its middle does not
                to_plane = jnp.abs(to_plane)
            flat = ray.origin + ray.direction * to_plane
            flat = flat - normal * (flat - _pick_vector(world.points, plane)).dot(normal)
            point, outward = choose(
                on_plane, (flat, normal), (point, outward) if rows else (flat, normal)
            )
        cosine = ray.direction.dot(outward)
        if plan.filtered and sphere is not None:
            # What only grazes a sphere meets its outside, wherever rounding puts the foot.
            outside = _starts_outside(ray, center, radius)
            cosine = jnp.where((surface >= plan.balls) & outside, -jnp.abs(cosine), cosine)
        if plan.filtered and plan.matte_planes + plan.metal_planes:
            height = (ray.origin - _pick_vector(world.points, plane)).dot(normal)
            against = jnp.where(height < 0, jnp.abs(cosine), -jnp.abs(cosine))
            cosine = jnp.where(on_plane, against, cosine)
        return point, outward, cosine

    return once(meeting, setting.one)


# Lamps: the next segment of a path from a matte surface is chosen both by its cosine and by the
# lamps in view, and each choice is weighted by the balance heuristic.
# Source: Veach, Robust Monte Carlo Methods for Light Transport Simulation (1997), section 9.2.


def _aim(
    scattered: Scattered, facing: Vec3, draw: Callable[[int], Real], setting: Setting
) -> Scattered:
    """The same with a ray to one of the lamps, and the densities of both choices.

    A lamp is chosen by its luminance times its solid angle, and a direction uniformly in the
    cone of its sphere. The density of a direction to a lamp is then its luminance over the sum.
    """
    (world, paint, _), plan, point = setting.tables, setting.plan, scattered.ray.origin
    zero = jnp.zeros_like(point.x)

    def weigh(best: Any, lamp: tuple[Vec3, Real, Real, Array]) -> tuple[Any, None]:
        total, number, u = best
        center, radius, luminance, row = lamp
        weight = luminance * _lamp_angle(point, facing, center, radius)
        total = total + weight
        share = weight / jnp.where(total > 0, total, 1.0)
        taken = u < share
        rest = jnp.where(taken, share, 1.0 - share)
        u = jnp.where(taken, u, u - share) / jnp.where(rest > 0, rest, 1.0)
        return (total, jnp.where(taken, row, number), u), None

    centers, radii = _lamps(world, plan)
    rows = centers, radii, _luminances(paint, plan), np.arange(plan.lamps, dtype=np.int32)

    def choice() -> tuple[Real, Array]:
        """The sum of all lamps' weights, and the number of one of them."""
        start = (zero, jnp.zeros(zero.shape, jnp.int32), draw(2))
        total, lamp, _ = _over(weigh, start, rows, plan.lamps)
        return total, lamp

    total, lamp = once(choice, setting.one)

    def aim() -> tuple[Vec3, Vec3]:
        """The axis of the lamp's cone, and a direction in the cone as if its axis were x."""
        radius, offset = _pick(rows[1], lamp), _pick_vector(centers, lamp) - point
        squared = offset.dot(offset)
        drop = draw(3) * _cap(jnp.minimum(radius * radius / squared, 1.0))
        return offset * inverse_root(squared), uniform_direction(0.5 * drop, draw(4))

    direction = _turn_to(*once(aim, setting.one))
    cosine = facing.dot(direction)
    chosen = jnp.maximum(facing.dot(scattered.ray.direction), 0.0) / np.pi
    density = _pick(rows[2], lamp) / (2.0 * np.pi * jnp.where(total > 0, total, 1.0))
    # Radiance · BRDF · cosine over both densities; the albedo is in the throughput.
    ahead = scattered.matte & (total > 0) & (cosine > 0)
    by_chance = jnp.maximum(cosine, 0.0) / np.pi
    both = jax.lax.stop_gradient(by_chance + jnp.where(ahead, density, 1.0))
    share = jnp.where(ahead, by_chance / both, 0.0)
    return scattered._replace(
        density=chosen,
        lamp=lamp + plan.first_lamp,
        to_lamp=Ray(point, direction),
        lamp_share=share,
        lamp_total=total,
    )


def _lamps(world: World, plan: Plan) -> tuple[Vec3, Float[Array, " lamps"]]:
    """Centres and radii of the lamps."""
    lamps = slice(plan.first_plane, plan.spheres)
    return Vec3(*(axis[lamps] for axis in world.centers)), world.radii[lamps]


def _luminances(paint: Paint, plan: Plan) -> Float[Array, " lamps"]:
    """A number for the brightness of each lamp: the mean of its channels."""
    first = plan.first_lamp - plan.balls
    brightness = [mean[first : first + plan.lamps] for mean in paint.mean]
    return sum(brightness[1:], brightness[0]) * (1.0 / len(brightness))


def _cap(squared_sine: Real) -> Real:
    """1 - cos θ from sin² θ, for θ below a right angle, without cancellation."""
    return squared_sine / (1.0 + jnp.sqrt(jnp.maximum(1.0 - squared_sine, 0.0)))


def _lamp_angle(point: Vec3, facing: Vec3, center: Vec3, radius: Real) -> Real:
    """Solid angle over 2π of a lamp's sphere; 0 where it is below the horizon or all around."""
    offset = center - point
    squared = offset.dot(offset)
    above = (offset.dot(facing) > -radius) & (squared > radius * radius * (1.0 + 1e-4))
    return jnp.where(above, _cap(radius * radius / jnp.where(above, squared, 1.0)), 0.0)


def _turn_to(axis: Vec3, vector: Vec3) -> Vec3:
    """The vector turned as the x axis is turned to `axis`.

    Source:
        Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6 (2017), with x for z.
    """
    sign = jnp.where(axis.x < 0, -1.0, 1.0)
    a = -1.0 / (sign + axis.x)
    b = axis.y * axis.z * a
    first = Vec3(-sign * axis.y, 1.0 + sign * axis.y * axis.y * a, sign * b)
    second = Vec3(-axis.z, b, sign + axis.z * axis.z * a)
    return axis * vector.x + first * vector.y + second * vector.z


def _lamplight(path: Path, counts: Array, scattered: Scattered, setting: Setting) -> Channels:
    """Radiance that comes straight from the lamp that was aimed at."""
    tables, plan = setting.tables, setting.plan
    assert scattered.to_lamp is not None
    assert scattered.lamp_share is not None
    to_lamp = path._replace(ray=scattered.to_lamp, footprint=None)
    ray, spheres = scattered.to_lamp, all_spheres(tables.world, plan, setting.one)
    surface = nearest(ray, tables.world, plan, path.surface, spheres)
    assert scattered.lamp is not None
    light = emitted(scattered.lamp, to_lamp, tables, plan, setting.one)
    factor = jnp.where(counts & (surface == scattered.lamp), scattered.lamp_share, 0.0)
    return tuple(t * factor * x for t, x in zip(scattered.throughput, light, strict=True))


def _chance_weight(surface: Array, scattered: Scattered, tables: Tables, plan: Plan) -> Real:
    """The balance heuristic's weight of light that was met by chance."""
    world, first = tables.world, plan.first_lamp
    assert scattered.density is not None
    assert scattered.lamp_total is not None
    lamp = jnp.clip(surface - first, 0, plan.lamps - 1)
    centers, radii = _lamps(world, plan)
    offset, radius = _pick_vector(centers, lamp) - scattered.ray.origin, _pick(radii, lamp)
    outside = offset.dot(offset) > radius * radius * (1.0 + 1e-4)
    weighed = scattered.matte & outside & (surface >= first) & (surface < first + plan.lamps)
    total = jnp.where(scattered.lamp_total > 0, scattered.lamp_total, 1.0)
    aimed = _pick(_luminances(tables.paint, plan), lamp) / (2.0 * np.pi * total)
    both = scattered.density + aimed
    weight = jax.lax.stop_gradient(scattered.density / jnp.where(both > 0, both, 1.0))
    return jnp.where(weighed, weight, 1.0)


def once(stage: Callable[[], Any], one: Array | None = None) -> Any:
    """`stage()`, computed once.

    XLA's CPU backend fuses loops by computing a value again in each of its users, through any
    number of stages. It does not fuse across an optimization barrier, if it is told to keep it
    (`programs.COMPILER_OPTIONS`). Elsewhere, as in a user's own program, a branch is a border.

    Args:
        stage: what to compute.
        one: the number 1, as an array that the compiler does not know: for a branch. None for a
            barrier.
    """
    if one is None:
        return jax.lax.optimization_barrier(stage())  # type: ignore[no-untyped-call]
    shape = jax.eval_shape(stage)
    return jax.lax.cond(
        one > 0, stage, lambda: jax.tree.map(lambda of: jnp.zeros(of.shape, of.dtype), shape)
    )


class Lanes(NamedTuple):
    """The film samples of some pixels: everything but the indices of the glasses.

    Lanes are (wavelengths J, samples S, pixels P). What does not depend on the wavelength has
    no such axis, and is traced once for all of them. `weights` are those of the samples that meet
    glass; the others count alike. A path ends when less than `cutoff` of its light is left.
    `one` is as in `once`.
    """

    world: World
    paint: Paint
    weights: Float[Array, "wavelengths samples channels"] | None
    projection: Projection
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
    return followed_radiance(plan, indices, lanes)


def followed_radiance(
    plan: Plan, indices: tuple[Array, ...], lanes: Lanes
) -> Float[Array, "wavelengths samples pixels channels"]:
    """`lane_radiance`, for forward derivatives alone: those in the lanes need no path to its end.

    Args:
        plan: as in `lane_radiance`.
        indices: as in `lane_radiance`.
        lanes: as in `lane_radiance`.
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
            lambda lanes: _radiance(plan, indices, lanes, _bounded),
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


Step = Callable[[Array, Path], Path]
"""From the numbers of some lanes, and their paths, to the paths advanced by one surface."""

Loop = Callable[[Step | None, Step, Path, Plan], Path]
"""Follows paths to their ends; by the first step once, where there is one, then by the other."""


def _radiance(plan: Plan, indices: tuple[Array, ...], lanes: Lanes, loop: Loop) -> Array:
    """`lane_radiance`, with the loop that the wanted derivative allows."""
    waves, rows = lanes.paint.mean[0].shape
    # The rows of all wavelengths in one table.
    mean, half = (tuple(c.reshape(-1) for c in part) for part in lanes.paint[:2])
    tables = Tables(lanes.world, lanes.paint._replace(mean=mean, half=half))
    first_rows = np.arange(waves, dtype=np.int32) * np.int32(rows)

    choices = _first_choices(lanes, plan) if plan.filtered else None

    def start(x: Real, y: Real, choices: Choices | None, first_row: Array) -> Path:
        seen = tables._replace(first_row=first_row)
        return start_path(lanes.projection, seen, plan, (x, y), lanes.cell, lanes.one, choices)

    every = jax.vmap(jax.vmap(start, (0, 0, 0, None)), (0, 0, 0, None))
    paths = jax.vmap(every, (None, None, None, 0))(lanes.x, lanes.y, choices, first_rows)
    if plan.scattering and lanes.weights is not None:
        # What a sample sees before it meets glass counts once, at its first wavelength.
        first = np.arange(lanes.weights.shape[0])[:, None, None] == 0
        seen = tuple(jnp.where(first, channel, 0.0) for channel in paths.radiance)
        paths = paths._replace(radiance=seen)
    shown: Array = jnp.stack(paths.radiance, axis=-1)
    radiance: Array = jnp.zeros_like(shown)
    if plan.first_lamp:
        if not plan.scattering:
            paths = paths._replace(radiance=(jnp.zeros_like(shown[..., 0]),) * plan.channels)
        radiance = _to_the_end(plan, indices, lanes, tables, paths, loop)
    if plan.scattering:
        if lanes.weights is None:
            return jnp.mean(radiance, axis=1, keepdims=True)
        # A path has been weighted where it met glass, if it did.
        return radiance * (1.0 / lanes.weights.shape[1])
    if lanes.weights is None:
        return jnp.mean(shown + radiance, axis=1, keepdims=True)
    # What the camera sees at once counts alike, what comes through glass by its wavelength.
    alike = 1.0 / (lanes.weights.shape[0] * lanes.weights.shape[1])
    return shown * alike + radiance * lanes.weights[:, :, None, :]


def _to_the_end(
    plan: Plan,
    indices: tuple[Array, ...],
    lanes: Lanes,
    tables: Tables,
    paths: Path,
    loop: Loop,
) -> Float[Array, "wavelengths samples pixels channels"]:
    """The radiance of the paths (J, S, P), followed to their ends."""
    numbers = Numbers(plan.numbers_per_bounce, lanes.seed, plan.dtype)
    starts = numbers.start(lanes.pixel)
    waves, samples, pixels = paths.alive.shape
    rows = tables.paint.mean[0].shape[0] // waves
    index = jnp.stack(indices, axis=-1) if indices else None
    weights = None
    if lanes.weights is not None:
        weights = tuple(jnp.moveaxis(lanes.weights * samples, -1, 0))

    def setting_of(lane: Array) -> Setting:
        wave, sample, pixel = lane // (samples * pixels), lane // pixels % samples, lane % pixels

        def draw(bounces: Array, decision: int) -> Real:
            words = look_up(starts, pixel), look_up(lanes.sample, sample)
            return numbers.of_bounce(*words, bounces, decision)

        def index_of(ball: Array | int) -> Real:
            assert index is not None
            return look_up(index, *(wave, sample)[: index.ndim - 1], ball)

        counts = None
        if weights is not None and plan.scattering:
            counts = tuple(look_up(channel, wave, sample) for channel in weights)
        return Setting(
            tables._replace(first_row=wave * rows),
            plan,
            draw,
            index_of,
            counts,
            None if weights is None else wave == 0,
            None,
            lanes.cutoff,
            lanes.one,
            differentiable=True,
        )

    def advance(lane: Array, path: Path, inside: bool | None) -> Path:
        return bounce(path, setting_of(lane), inside)

    def every_path(inside: bool | None) -> Step:
        return jax.vmap(partial(advance, inside=inside))

    flat = jax.tree.map(lambda leaf: leaf.reshape(-1), paths)
    if plan.scattering or plan.balls > 1 or plan.nested:
        ended = loop(None, every_path(None), flat, plan)
    else:
        # One ball apart from all else is entered once; after that its paths stay inside.
        ended = loop(every_path(False), every_path(True), unentered(flat), plan)
    if plan.filtered:
        lanes_of = np.arange(waves * samples * pixels, dtype=np.int32)
        together = sharing(samples)

        def shown(lane: Array, path: Path, start: Path) -> Path:
            number = look_up(lanes.sample, lane // pixels % samples) % together
            across, down = ((number.astype(plan.dtype) * s + 0.5) % 1.0 for s in SHIFTS)
            return _shown(path, start, (across, down), setting_of(lane))

        ended = jax.vmap(shown)(lanes_of, ended, flat)
    radiance = jnp.stack(ended.radiance, axis=-1).reshape(waves, samples, pixels, -1)
    if ended.lit is None:
        return radiance
    grid = (waves, samples, pixels)
    lit, choices = jax.tree.map(lambda leaf: leaf.reshape(grid), (ended.lit, ended.choices))
    return _lit_alike(radiance, lit, choices)


def _first_choices(lanes: Lanes, plan: Plan) -> Choices:
    """Of paths (S, P): numbers that are even over the samples of each part of a pixel."""
    numbers = Numbers(plan.numbers_per_bounce, lanes.seed, plan.dtype)
    starts = numbers.start(lanes.pixel)
    together = sharing(lanes.sample.shape[0])
    part, within = lanes.sample // together, lanes.sample % together
    by_pixel = jax.vmap(numbers.of_film, (0, None, None))
    shift = jax.vmap(by_pixel, (None, 0, None))(starts, part, 2)
    number = (within.astype(shift.dtype)[:, None] + shift) * (1.0 / together)
    return Choices(number, jnp.ones_like(number), jnp.zeros(number.shape, jnp.int32))


def _lit_alike(radiance: Array, lit: Lit, choices: Choices) -> Array:
    """The same radiance, with derivatives of less noise.

    A path's derivative is that of what it counts times what it is lit by where it scatters first,
    and that of the latter. All paths of a part of a pixel that have chosen alike see one point of
    a texture by one footprint: of the first term they need not be as many as chance made them, nor
    lit as each of them is by chance. It is taken as if they were as many as their chance says, and
    each lit as they are in the mean.

    Args:
        radiance: (J, S, P, channels) of the paths.
        lit: of the paths, (J, S, P).
        choices: of the paths, (J, S, P).
    """
    waves, samples, pixels, channels = radiance.shape
    together = sharing(samples)

    def parts(values: Array) -> Array:
        return values.reshape(waves, -1, together, pixels)

    chosen = lit.surface >= 0
    alike = parts(chosen)[:, :, None] & parts(chosen)[:, :, :, None]
    for of in (choices.code, lit.surface):
        alike = alike & (parts(of)[:, :, None] == parts(of)[:, :, :, None])
    pairs = alike.astype(radiance.dtype)

    def total(values: Array) -> Array:
        """Over the paths that have chosen alike."""
        sums = jnp.einsum("jbstp,jbtp->jbsp", pairs, parts(values))
        return sums.reshape(waves, samples, pixels)

    # As many as chance says, and not fewer than one: where there is none, none stands for it.
    expected = jnp.maximum(choices.chance * together, 1.0)
    ratio = expected / jnp.maximum(total(chosen.astype(radiance.dtype)), 1.0)
    shown = []
    for channel in range(channels):
        whole, through = radiance[..., channel], lit.throughput[channel]
        after, still = jax.lax.stop_gradient((whole - lit.before[channel], through))
        some = chosen & (still != 0)
        divisor = jnp.where(some, still, 1.0)
        light = jnp.where(some, after / divisor, 0.0)
        mean = total(light) / jnp.maximum(total(some.astype(light.dtype)), 1.0)
        change = jnp.where(some, through / divisor - 1.0, 0.0)
        shown.append(whole + change * jax.lax.stop_gradient(mean * ratio * still - after))
    return jnp.stack(shown, axis=-1)


BLOCK_BYTES = 2048
"""Of one number of each of the paths that advance together on a processor core. With the slopes
along several numbers of a scene twice as many take a sixth longer: they leave the nearest cache."""


def _until_done(enter: Step | None, advance: Step, paths: Path, plan: Plan) -> Path:
    """All paths to their ends; no derivative in reverse mode.

    Some paths meet one surface and others fifty. They are followed in blocks, and where enough of
    a block have ended the others move up.
    """
    total = paths.alive.shape[0]
    together = BLOCK_BYTES // np.dtype(plan.dtype).itemsize
    block = min(together, total) if jax.default_backend() == "cpu" else total
    spare = -total % block

    def padded(leaf: Array) -> Array:
        return jnp.pad(leaf, (0, spare), mode="edge")

    def sweep(step: Callable[[Array, Path, Array], Path], state: Any) -> Any:
        """All blocks by one step each; what still goes on moves to the front."""
        count = state[1]

        def of_block(number: Array, carried: Any) -> Any:
            lanes, kept, results = carried
            start = number * block
            lane, path = jax.tree.map(
                lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, start, block), lanes
            )
            there = start + np.arange(block, dtype=np.int32) < count
            lane = jnp.where(there, lane, total)
            path = path._replace(alive=path.alive & there)
            path = step(lane, path, count)
            kept_of = path.radiance, path.lit, path.choices
            results = jax.tree.map(lambda whole, part: whole.at[lane].set(part), results, kept_of)
            order = first_places(path.alive)
            lanes = jax.tree.map(
                lambda whole, part: jax.lax.dynamic_update_slice_in_dim(
                    whole, look_up(part, order), kept, 0
                ),
                lanes,
                (lane, path),
            )
            return lanes, kept + jnp.sum(path.alive, dtype=jnp.int32), results

        blocks = (count + (block - 1)) // block
        none = jnp.zeros((), jnp.int32)
        return jax.lax.fori_loop(0, blocks, of_block, (state[0], none, state[2]))

    def once_in(lane: Array, path: Path, _: Array) -> Path:
        assert enter is not None
        return _unless_done(partial(enter, lane), path)

    def thinned(lane: Array, path: Path, count: Array) -> Path:
        going = jnp.sum(path.alive, dtype=jnp.int32)
        # Until half of them have ended; the last block has none to fill it.
        least = jnp.where(count <= block, 0, going // 2)
        return jax.lax.while_loop(
            lambda path: jnp.sum(path.alive, dtype=jnp.int32) > least,
            partial(advance, lane),
            path,
        )

    numbers = jnp.arange(total + spare, dtype=jnp.int32)
    results = jax.tree.map(
        lambda leaf: jnp.zeros(total + 1, leaf.dtype),
        (paths.radiance, paths.lit, paths.choices),
    )
    state = (numbers, jax.tree.map(padded, paths)), jnp.asarray(total, jnp.int32), results
    if enter is not None:
        state = sweep(once_in, state)
    state = jax.lax.while_loop(lambda state: state[1] > 0, partial(sweep, thinned), state)
    radiance, lit, choices = jax.tree.map(lambda leaf: leaf[:total], state[2])
    return paths._replace(radiance=radiance, lit=lit, choices=choices)


def first_places(chosen: Bool[Array, " places"]) -> Int[Array, " places"]:
    """The places that are chosen, in their order; then zeros."""
    count = chosen.shape[0]
    order = jnp.where(chosen, jnp.cumsum(chosen, dtype=jnp.int32) - 1, count)
    places = np.arange(count, dtype=np.int32)
    return jnp.zeros(count, jnp.int32).at[order].set(places, mode="drop")


def _bounded(enter: Step | None, advance: Step, paths: Path, plan: Plan) -> Path:
    """All paths to their ends in a fixed number of turns, idle ones skipped; any derivative."""
    numbers = np.arange(paths.alive.shape[0], dtype=np.int32)
    # Borders between equal media count for no bounce; a chord meets two of each ball at most.
    turns = (plan.depth - 1) * (2 * plan.balls if plan.nested else 1)

    def turn(paths: Path, _: None) -> tuple[Path, None]:
        return _unless_done(partial(advance, numbers), paths), None

    if enter is not None:
        paths = _unless_done(partial(enter, numbers), paths)
    return jax.lax.scan(turn, paths, length=turns)[0]


def _unless_done(advance: Callable[[Path], Path], paths: Path) -> Path:
    return jax.lax.cond(jnp.any(paths.alive), advance, lambda paths: paths, paths)
