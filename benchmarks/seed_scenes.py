"""The scenes of the timing studies: 2 to 16 spheres of matte, metal and glass before a white sky.

`seed_scenes.json` holds them as numbers. Run alone this prints what each scene is made of. It
imports diffdisp only where a scene is built: the interpreters of other renderers read the numbers.
"""

import json
from typing import TYPE_CHECKING, Any

from record import ROOT, print_table

if TYPE_CHECKING:
    from diffdisp import Scene
    from diffdisp.material import Material

DATA: dict[str, Any] = json.loads((ROOT / "benchmarks/seed_scenes.json").read_text())
COUNTS = tuple(sorted(map(int, DATA["scenes"])))
"""How many spheres the scenes have."""
NOMINAL_FOV: float = DATA["camera"]["vfov_deg_nominal"]
"""Vertical field of view that the original study asks for, degrees."""
EFFECTIVE_FOV: float = DATA["camera"]["vfov_deg_effective"]
"""The one that its pictures really have, degrees."""
SAMPLES: int = DATA["spp"]
"""Samples per pixel of the original study."""
DEPTH: int = DATA["max_depth"]
"""Segments that a path may have."""
CONSTANT_INDEX = 1.5168
"""Of the glass where it does not disperse: N-BK7's n_d. Source: Schott data sheet N-BK7 517642."""


def material_of(sphere: dict[str, Any]) -> dict[str, Any]:
    """The entry of the file that a sphere is made of."""
    material: dict[str, Any] = DATA["materials"][sphere["material"]]
    return material


def has_glass(count: int) -> bool:
    """Whether any of the `count` spheres is glass."""
    return any(material_of(s)["kind"] == "dielectric" for s in DATA["scenes"][str(count)])


def make_scene(count: int, vertical_fov: float, *, dispersive: bool = True) -> "Scene":
    """The scene of `count` spheres.

    Args:
        count: one of `COUNTS`.
        vertical_fov: degrees.
        dispersive: glass of N-BK7; otherwise of `CONSTANT_INDEX` at every wavelength.
    """
    from diffdisp import Background, Camera, Object, Scene, Sphere

    camera = DATA["camera"]
    objects = [
        Object(Sphere(s["center"], s["radius"]), _make_material(material_of(s), dispersive))
        for s in DATA["scenes"][str(count)]
    ]
    return Scene(
        Camera(camera["look_from"], camera["look_at"], camera["up"], vertical_fov),
        objects,
        Background(DATA["background"]),
    )


def _make_material(entry: dict[str, Any], dispersive: bool) -> "Material":
    """The material of an entry of the file."""
    from diffdisp import Checker, Dielectric, Lambertian, Metal, Sellmeier

    match entry:
        case {"kind": "lambertian", "texture": "checker"}:
            return Lambertian(Checker(entry["even"], entry["odd"], scale=entry["frequency"]))
        case {"kind": "lambertian"}:
            return Lambertian(entry["albedo"])
        case {"kind": "metal"}:
            return Metal(entry["albedo"], entry["fuzz"])
        case {"kind": "dielectric"} if dispersive:
            return Dielectric(Sellmeier(entry["sellmeier_b"], entry["nbk7_sellmeier_c_um2"]))
        case {"kind": "dielectric"}:
            return Dielectric(Sellmeier([CONSTANT_INDEX**2 - 1, 0, 0], [0, 0, 0]))
    raise ValueError(f"no such material: {entry}")


def main() -> None:
    """Print what each scene is made of."""
    kinds = ("lambertian", "metal", "dielectric")
    made_of = {
        count: [material_of(sphere)["kind"] for sphere in DATA["scenes"][str(count)]]
        for count in COUNTS
    }
    rows = [(count, *map(found.count, kinds)) for count, found in made_of.items()]
    print_table(("spheres", *kinds), rows)


if __name__ == "__main__":
    main()
