"""Scene files: TOML to `Scene` and back; every mistake in a file is told at once."""

import dataclasses
import json
import math
import os
import re
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import tomli_w
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    field_validator,
)
from pydantic_core import ErrorDetails

from diffdisp.camera import Camera
from diffdisp.dispersion import Sellmeier
from diffdisp.geometry import Plane, Sphere
from diffdisp.glasses import named_glass
from diffdisp.image import replacing
from diffdisp.material import Dielectric, Emitter, Lambertian, Material, Metal
from diffdisp.scene import Background, Object, Scene, pairing_error
from diffdisp.texture import Checker, Checker2D, Solid, Texture

KeyPath = tuple[str | int, ...]
"""Where a value stands in a file: `("object", 1, "shape", "radius")`."""


class SceneError(ValueError):
    """What is wrong with a scene file: one line for each mistake, also in `problems`."""

    def __init__(self, problems: Sequence[str]) -> None:
        """Keep the mistakes, at least one, in the order of the file."""
        super().__init__(problems)
        self.problems = list(problems)

    def __str__(self) -> str:
        """All mistakes, one in a line."""
        return "\n".join(self.problems)


class _Problem(NamedTuple):
    """A mistake, and where it stands."""

    path: KeyPath
    text: str


# The file format. Each field's description ends the sentence "allowed: ..." of its messages.


def _nonzero(vector: list[float]) -> list[float]:
    """Refuse the vector that has no direction."""
    if not any(vector):
        raise ValueError("allowed: three numbers, not all zero")
    return vector


def _known_glass(name: str) -> str:
    """Refuse a name that is not in the table; `named_glass` says what is."""
    named_glass(name)
    return name


def _rising(validity: list[float]) -> list[float]:
    """Refuse an empty range of wavelengths."""
    if not 0 <= validity[0] < validity[1]:
        raise ValueError("allowed: [low, high] in µm with 0 ≤ low < high")
    return validity


_Three = Annotated[
    list[float], Field(min_length=3, max_length=3, description="three finite numbers")
]
_Direction = Annotated[_Three, AfterValidator(_nonzero)]
_COLOR = "three finite numbers ≥ 0"
_Color = Annotated[
    list[Annotated[float, Field(ge=0)]], Field(min_length=3, max_length=3, description=_COLOR)
]
_ALBEDO = "three finite numbers from 0 to 1"
_Length = Annotated[float, Field(gt=0, description="a finite number > 0")]
_Factor = Annotated[float, Field(ge=0, description="a finite number ≥ 0")]

_SHAPES = "sphere, plane"
_MATERIALS = "lambertian, metal, dielectric, emitter"
_TEXTURES = "solid, checker, checker2d"
_KINDS = {"shape": _SHAPES, "material": _MATERIALS, "texture": _TEXTURES}
_SCATTERING = {"type=lambertian", "type=metal"}
"""The materials whose colours are albedos: above 1 they would create light."""


def _tag(value: object) -> str | None:
    """Which model of a union checks `value`; None where it names no type.

    A dielectric has two: what must and what may stand in it depends on how its glass is given.
    """
    if isinstance(value, list):
        return "color"
    kind = value.get("type") if isinstance(value, dict) else None
    if not isinstance(value, dict) or not isinstance(kind, str):
        return None
    by_name = "glass" in value or not {"B", "C"} & value.keys()
    return "glass by name" if kind == "dielectric" and by_name else f"type={kind}"


class _Table(BaseModel):
    """A table of the file: its keys are the arguments of the module it stands for."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, strict=True)

    def arguments(self) -> dict[str, Any]:
        """What the file gives, for the constructor; the rest has the constructor's default."""
        values = {name: getattr(self, name) for name in self.model_fields_set if name != "type"}
        return {
            name: value.build() if isinstance(value, _Solid | _Checker | _Checker2D) else value
            for name, value in values.items()
        }


class _Camera(_Table):
    """The `[camera]` table."""

    look_from: _Three
    look_at: _Three
    up: _Direction = Field(default=[0.0, 1.0, 0.0], validate_default=True)
    vertical_fov: Annotated[
        float, Field(gt=0, lt=180, description="degrees, above 0 and below 180")
    ] = 45.0

    # A field validator sees the fields above that are right, so that a mistake elsewhere in the
    # table hides none of these; a model validator would run only on a table without mistakes.
    # `info` is a pydantic `ValidationInfo`, a protocol that run-time checks of types refuse.
    @field_validator("look_at")
    @classmethod
    def _differs(cls, look_at: list[float], info: Any) -> list[float]:
        if look_at == info.data.get("look_from"):
            raise ValueError("the same point as look_from; allowed: any other point")
        return look_at

    @field_validator("up")
    @classmethod
    def _spans_a_picture(cls, up: list[float], info: Any) -> list[float]:
        if {"look_from", "look_at"} <= info.data.keys():
            view = [
                a - b for a, b in zip(info.data["look_at"], info.data["look_from"], strict=True)
            ]
            # Below this angle float32, with 1e-7 of rounding, no longer knows which way is up.
            if not _sine(view, up) > 1e-6:
                raise ValueError(
                    "parallel to the view; allowed: any direction not along look_at - look_from"
                )
        return up


class _Background(_Table):
    """The `[background]` table."""

    color: _Color = [0.0, 0.0, 0.0]


class _Sphere(_Table):
    """A ball."""

    type: Literal["sphere"]
    center: _Three
    radius: _Length

    def build(self) -> Sphere:
        return Sphere(**self.arguments())


class _Plane(_Table):
    """An infinite plane."""

    type: Literal["plane"]
    point: _Three
    normal: _Direction

    def build(self) -> Plane:
        return Plane(**self.arguments())


class _Solid(_Table):
    """One colour."""

    type: Literal["solid"]
    color: _Color

    def build(self) -> Solid:
        return Solid(**self.arguments())


class _Checker(_Table):
    """Cubes in space."""

    type: Literal["checker"]
    even: _Color
    odd: _Color
    scale: _Length = 10.0

    def build(self) -> Checker:
        return Checker(**self.arguments())


class _Checker2D(_Table):
    """Square tiles on a plane."""

    type: Literal["checker2d"]
    even: _Color
    odd: _Color
    tile: _Length

    def build(self) -> Checker2D:
        return Checker2D(**self.arguments())


_Texture = Annotated[
    Annotated[_Solid, Tag("type=solid")]
    | Annotated[_Checker, Tag("type=checker")]
    | Annotated[_Checker2D, Tag("type=checker2d")]
    | Annotated[_Color, Tag("color")],
    Discriminator(_tag),
]
_A_TEXTURE_TABLE = f"or a table whose type is one of {_TEXTURES}"
_Albedo = Annotated[_Texture, Field(description=f"{_ALBEDO}, {_A_TEXTURE_TABLE}")]
_Emission = Annotated[_Texture, Field(description=f"{_COLOR}, {_A_TEXTURE_TABLE}")]


class _Lambertian(_Table):
    """Matte."""

    type: Literal["lambertian"]
    texture: _Albedo

    def build(self) -> Lambertian:
        return Lambertian(**self.arguments())


class _Metal(_Table):
    """A mirror."""

    type: Literal["metal"]
    texture: _Albedo
    fuzz: _Factor = 0.0

    def build(self) -> Metal:
        return Metal(**self.arguments())


class _NamedDielectric(_Table):
    """Glass by its name in the table."""

    type: Literal["dielectric"]
    glass: Annotated[
        str,
        Field(description="the name of a glass; or B and C in its place"),
        AfterValidator(_known_glass),
    ]

    def build(self) -> Dielectric:
        return Dielectric(named_glass(self.glass))


class _Dielectric(_Table):
    """Glass by its coefficients."""

    type: Literal["dielectric"]
    B: Annotated[_Three, Field(description="three finite numbers, together with C")]
    C: Annotated[_Three, Field(description="three finite numbers, µm², together with B")]
    validity: Annotated[
        list[float],
        Field(min_length=2, max_length=2, description="[low, high] in µm with 0 ≤ low < high"),
        AfterValidator(_rising),
        # A factory keeps infinity, which JSON has not, out of the schema.
    ] = Field(default_factory=lambda: [0.0, math.inf])
    name: Annotated[str, Field(description="a text")] = ""

    def build(self) -> Dielectric:
        return Dielectric(Sellmeier(**self.arguments()))


class _Emitter(_Table):
    """A lamp."""

    type: Literal["emitter"]
    texture: _Emission
    intensity: _Factor = 1.0

    def build(self) -> Emitter:
        return Emitter(**self.arguments())


class _Object(_Table):
    """An `[[object]]` table."""

    name: Annotated[str, Field(description="a text that no other object is named by")] = ""
    shape: Annotated[
        Annotated[_Sphere, Tag("type=sphere")] | Annotated[_Plane, Tag("type=plane")],
        Field(description=f"a table whose type is one of {_SHAPES}"),
        Discriminator(_tag),
    ]
    material: Annotated[
        Annotated[_Lambertian, Tag("type=lambertian")]
        | Annotated[_Metal, Tag("type=metal")]
        | Annotated[_NamedDielectric, Tag("glass by name")]
        | Annotated[_Dielectric, Tag("type=dielectric")]
        | Annotated[_Emitter, Tag("type=emitter")],
        Field(description=f"a table whose type is one of {_MATERIALS}"),
        Discriminator(_tag),
    ]

    def build(self) -> Object:
        return Object(self.shape.build(), self.material.build(), self.name)


class _Scene(_Table):
    """A scene file."""

    camera: Annotated[_Camera, Field(description="a [camera] table with look_from and look_at")]
    background: Annotated[_Background, Field(description="a [background] table with a color")] = (
        _Background()
    )
    object: Annotated[
        list[_Object], Field(description="[[object]] tables, each with a shape and a material")
    ] = []

    def build(self) -> Scene:
        camera = Camera(**self.camera.arguments())
        background = Background(**self.background.arguments())
        return Scene(camera, tuple(table.build() for table in self.object), background)


_TABLES: dict[str, type[_Table]] = {
    "": _Scene,
    "camera": _Camera,
    "background": _Background,
    "object": _Object,
    "type=sphere": _Sphere,
    "type=plane": _Plane,
    "type=solid": _Solid,
    "type=checker": _Checker,
    "type=checker2d": _Checker2D,
    "type=lambertian": _Lambertian,
    "type=metal": _Metal,
    "glass by name": _NamedDielectric,
    "type=dielectric": _Dielectric,
    "type=emitter": _Emitter,
}

# Reading.


def load_scene(path: str | os.PathLike[str]) -> Scene:
    """The scene in a TOML file.

    Args:
        path: the file.

    Returns:
        The scene; what the file leaves out has the default of its module.

    Raises:
        SceneError: the file cannot be read, is no TOML, or does not describe a scene.
    """
    file_name = os.fspath(path)
    try:
        content = Path(path).read_bytes()
    except (OSError, ValueError) as error:
        raise SceneError([f"{file_name}: cannot be read: {_reason(error)}"]) from error
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise SceneError([f"{file_name}:{line}: is not UTF-8 text"]) from error
    return scene_from_toml(text, file_name)


def scene_from_toml(text: str, file_name: str = "<text>") -> Scene:
    """The scene that a TOML text describes.

    Args:
        text: the content of a scene file.
        file_name: what messages call the text.

    Raises:
        SceneError: the text is no TOML, or does not describe a scene.
    """
    # As tomllib does itself: lines are counted on the same text that it parses.
    text = text.replace("\r\n", "\n")
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError([_syntax_message(error, text, file_name)]) from error
    table, problems = _checked(data)
    if table is None:
        lines = _lines_of(text)
        placed = sorted(
            ((_line(problem.path, lines), _message(problem)) for problem in problems),
            key=lambda pair: pair[0],
        )
        raise SceneError([f"{file_name}:{line}: {message}" for line, message in placed])
    return table.build()


def scene_schema() -> dict[str, Any]:
    """The JSON schema of a scene file; rules that join several fields are not in it."""
    return _Scene.model_json_schema()


def _reason(error: Exception) -> str:
    """What the system says, without the number and the file name around it."""
    return (isinstance(error, OSError) and error.strerror) or str(error)


def _syntax_message(error: Exception, text: str, file_name: str) -> str:
    """Where a text stops being TOML."""
    place = re.search(r" \(at line (\d+)", str(error))
    at_end = "at end of document" in str(error)
    line = place[1] if place else str(text.rstrip().count("\n") + 1 if at_end else 1)
    reason = "nested too deeply" if isinstance(error, RecursionError) else str(error)
    return f"{file_name}:{line}: is not TOML: {reason}"


def _checked(data: dict[str, Any]) -> tuple[_Scene | None, list[_Problem]]:
    """The checked tables, or None and all that is wrong with them."""
    problems = [*_pairing_problems(data), *_name_problems(data), *_albedo_problems(data)]
    try:
        table = _Scene.model_validate(data)
    except ValidationError as error:
        return None, [*map(_problem, error.errors(include_url=False)), *problems]
    return (None if problems else table), problems


# Problems that join several tables look at the raw data, so that a mistake in one table does not
# hide them.


def _raw_objects(data: dict[str, Any]) -> Iterator[tuple[int, dict[str, Any]]]:
    """Number and content of each object that is a table at all."""
    objects = data.get("object")
    for index, table in enumerate(objects if isinstance(objects, list) else []):
        if isinstance(table, dict):
            yield index, table


def _name_problems(data: dict[str, Any]) -> Iterator[_Problem]:
    """Names that an earlier object has."""
    first: dict[str, int] = {}
    for index, table in _raw_objects(data):
        name = table.get("name")
        if isinstance(name, str) and name and first.setdefault(name, index) != index:
            text = (
                f"found {_found(name)}, the name of object[{first[name]}] too; allowed: any other"
            )
            yield _Problem(("object", index, "name"), text)


def _albedo_problems(data: dict[str, Any]) -> Iterator[_Problem]:
    """Channels above 1 of materials that give no light of their own."""
    for index, table in _raw_objects(data):
        material = table.get("material")
        if not isinstance(material, dict) or _tag(material) not in _SCATTERING:
            continue
        texture = material.get("texture")
        colors: dict[KeyPath, Any] = {(): texture}
        if isinstance(texture, dict):
            colors = {(name,): texture.get(name) for name in ("color", "even", "odd")}
        for place, color in colors.items():
            triple = color if isinstance(color, list) and len(color) == 3 else []
            for channel, value in enumerate(triple):
                # Beyond the largest float a number is not finite, which is told already.
                if isinstance(value, int | float) and 1 < value <= sys.float_info.max:
                    path = ("object", index, "material", "texture", *place, channel)
                    yield _Problem(path, f"found {_found(value)}; allowed: {_ALBEDO}")


# Whether a shape goes with a material depends on their types only: one of each stands for all.
_A_SHAPE = {
    "type=sphere": Sphere(np.zeros(3), np.ones(())),
    "type=plane": Plane(np.zeros(3), np.ones(3)),
}
_A_TEXTURE: dict[str | None, Texture] = {
    "color": Solid(np.zeros(3)),
    "type=solid": Solid(np.zeros(3)),
    "type=checker": Checker(np.zeros(3), np.zeros(3)),
    "type=checker2d": Checker2D(np.zeros(3), np.zeros(3), np.ones(())),
}
_TEXTURED = {"type=lambertian": Lambertian, "type=metal": Metal, "type=emitter": Emitter}


def _a_material(table: Any) -> Material | None:
    """A material of the types that a raw table names; None where they are unknown."""
    kind = _tag(table)
    if kind in ("type=dielectric", "glass by name"):
        return Dielectric(Sellmeier(np.zeros(3), np.zeros(3)))
    textured = _TEXTURED.get(kind or "")
    texture = _A_TEXTURE.get(_tag(table.get("texture"))) if textured else None
    return textured(texture) if textured and texture else None


def _pairing_problems(data: dict[str, Any]) -> Iterator[_Problem]:
    """Shapes that cannot be made of their material."""
    for index, table in _raw_objects(data):
        shape = _A_SHAPE.get(_tag(table.get("shape")) or "")
        text = pairing_error(shape, _a_material(table.get("material")))
        if text:
            yield _Problem(("object", index, "material"), text)


# Messages.


def _problem(error: ErrorDetails) -> _Problem:
    """What pydantic found, in the words of the file."""
    place, found = error["loc"], error["input"]
    path, names = _without_tags(place), [step for step in place if isinstance(step, str)]
    owner, field = (names[-2] if len(names) > 1 else ""), names[-1]
    if error["type"] == "extra_forbidden":
        return _Problem(path, _extra_text(owner, field))
    if error["type"] in ("union_tag_invalid", "union_tag_not_found") and isinstance(found, dict):
        kind = f"found {_found(found['type'])}; allowed" if "type" in found else "missing; required"
        return _Problem((*path, "type"), f"{kind}: {' or '.join(_KINDS[field].rsplit(', ', 1))}")
    allowed = _COLOR if owner == "texture" else _TABLES[owner].model_fields[field].description
    if allowed == _COLOR and not _SCATTERING.isdisjoint(names):
        allowed = _ALBEDO
    if error["type"] == "missing":
        return _Problem(path, f"missing; required: {allowed}")
    if error["type"] == "value_error":
        return _Problem(path, f"found {_found(found)}; {error['ctx']['error']}")
    return _Problem(path, f"found {_found(found)}; allowed: {allowed}")


def _without_tags(place: KeyPath) -> KeyPath:
    """The path in the file: pydantic puts the tag of a union's model behind the union's key."""
    return tuple(
        step for before, step in zip((None, *place), place, strict=False) if before not in _KINDS
    )


def _extra_text(owner: str, field: str) -> str:
    """Why a table may not have this field, and which it may have."""
    if owner not in ("type=dielectric", "glass by name"):
        return f"unknown field; allowed: {', '.join(_TABLES[owner].model_fields)}"
    known = field in _NamedDielectric.model_fields or field in _Dielectric.model_fields
    fault = "not together with the other fields" if known else "unknown field"
    return f"{fault}; allowed: type, and either glass, or B and C (also validity, name)"


def _found(value: object) -> str:
    """A value of the file as it is written there, shortened."""
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        inner = [_found(v) if not isinstance(v, list) else "[...]" for v in value[:4]]
        return f"[{', '.join(inner + ['...'] * (len(value) > 4))}]"
    if isinstance(value, int) and value.bit_length() > 64:
        return f"an integer of {value.bit_length()} bits"
    text = json.dumps(value, ensure_ascii=False) if isinstance(value, bool | str) else str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _message(problem: _Problem) -> str:
    """Path and text: `object[1].shape.radius: found -1; allowed: a finite number > 0`."""
    path = ""
    for step in problem.path:
        if isinstance(step, int):
            path += f"[{step}]"
        else:
            bare = re.fullmatch(r"[A-Za-z0-9_-]+", step)
            path += ("." if path else "") + (step if bare else _found(step))
    return f"{path}: {problem.text}"


def _sine(a: list[float], b: list[float]) -> float:
    """Sine of the angle between two vectors; NaN if one is zero."""
    (ax, ay, az), (bx, by, bz) = ([x / math.hypot(*v) for x in v] for v in (a, b))
    return math.hypot(ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


# Lines. tomllib tells none, so the text is cut into statements (a header, or a key and its value),
# each the shortest run of lines that tomllib itself can read.

_DEEPEST = 8
"""Steps of a path beyond which no line is kept; the longest path of the format has six."""
_MOST_REREAD = 300_000
"""Characters read again before the search for lines gives up; a huge array would take minutes."""


def _line(path: KeyPath, lines: dict[KeyPath, int]) -> int:
    """The line of a path, or of the nearest table around it."""
    return next((lines[path[:n]] for n in range(len(path), 0, -1) if path[:n] in lines), 1)


def _lines_of(text: str) -> dict[KeyPath, int]:
    """The line on which each path of a TOML text first stands."""
    lines: dict[KeyPath, int] = {}
    last: dict[KeyPath, int] = {}
    table: KeyPath = ()
    for line, statement, is_header in _statements(text):
        if is_header:
            table = _enter(statement, last)
            found: Iterator[KeyPath] = (table[:n] for n in range(1, min(len(table), _DEEPEST) + 1))
        else:
            found = _paths(statement, table)
        for path in found:
            lines.setdefault(path, line)
    return lines


def _statements(text: str) -> Iterator[tuple[int, dict[str, Any], bool]]:
    """Line, content and whether it is a header, of each statement of a TOML text.

    An array over several lines comes once for each line that ends between two of its elements,
    read as if it were closed there, with the line on which its newest elements begin.
    """
    chunk, newest, reread = "", 1, 0
    for number, line in enumerate(text.split("\n"), 1):
        reread += len(chunk)
        if reread > _MOST_REREAD:
            return
        chunk += line + "\n"
        whole = _parsed(chunk)
        content = _parsed(chunk + "]") if whole is None else whole
        if content is not None:
            yield newest, content, chunk.lstrip().startswith("[")
            newest = number + 1
        if whole is not None:
            chunk = ""


def _parsed(text: str) -> dict[str, Any] | None:
    """The content of a TOML text; None if it is none."""
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError):
        return None


def _enter(header: dict[str, Any], last: dict[KeyPath, int]) -> KeyPath:
    """The path of the table that a header opens; `last` counts the tables of each array."""
    path: KeyPath = ()
    while header:
        ((key, value),) = header.items()
        path += (key,)
        if isinstance(value, list):
            last[path] = last.get(path, -1) + 1
            value = value[0]
        if path in last:
            path += (last[path],)
        header = value
    return path


def _paths(value: object, path: KeyPath) -> Iterator[KeyPath]:
    """The path of a value, and of all within it."""
    yield path
    items = value.items() if isinstance(value, dict) else ()
    for key, inner in enumerate(value) if isinstance(value, list) else items:
        if len(path) < _DEEPEST:
            yield from _paths(inner, (*path, key))


# Writing.


def save_scene(scene: Scene, path: str | os.PathLike[str]) -> None:
    """Write a scene as a TOML file that `load_scene` reads back to an equal scene.

    The file is written beside and renamed: an interrupted run leaves the old one whole.

    Args:
        scene: the scene; its leaves are numbers, not traced.
        path: the file, in a folder that exists.

    Raises:
        SceneError: the scene would not be read back (its values are not legal in a file), or the
            file cannot be written.
    """
    file = Path(path)
    data = _scene_table(scene)
    _, problems = _checked(data)
    if problems:
        raise SceneError([f"{file}: {_message(problem)}" for problem in problems])
    try:
        with replacing(file) as beside:
            beside.write_text(_compact(tomli_w.dumps(data)), encoding="utf-8", newline="\n")
    except OSError as error:
        raise SceneError([f"{file}: cannot be written: {_reason(error)}"]) from error


def _compact(toml: str) -> str:
    """Arrays of numbers on one line each; tomli-w, which escapes newlines in texts, spreads them.

    Where a bracket ends a line an array begins: headers end in the other bracket.
    """
    return re.sub(
        r"\[\n((?: +[-+.\w]+,\n)+)\]",
        lambda array: f"[{', '.join(array[1].replace(',', '').split())}]",
        toml,
    )


def _scene_table(scene: Scene) -> dict[str, Any]:
    """The scene as the tables of a file."""
    objects = [_object_table(obj) for obj in scene.objects]
    return {
        "camera": _arguments(scene.camera),
        "background": _arguments(scene.background),
        **({"object": objects} if objects else {}),
    }


def _object_table(obj: Object) -> dict[str, Any]:
    """An object as a table; an empty name is left out."""
    name = {"name": obj.name} if obj.name else {}
    return {**name, "shape": _module_table(obj.shape), "material": _module_table(obj.material)}


def _module_table(module: Sphere | Plane | Material | Texture) -> dict[str, Any]:
    """A shape, material or texture as a table with its type."""
    kind = {"type": type(module).__name__.lower()}
    if isinstance(module, Dielectric):
        return {**kind, **_glass_table(module.glass)}
    if isinstance(module, Lambertian | Metal | Emitter):
        return {**kind, **_arguments(module), "texture": _module_table(module.texture)}
    return {**kind, **_arguments(module)}


def _glass_table(glass: Sellmeier) -> dict[str, Any]:
    """The name alone of a glass that equals the one of the table; else its coefficients."""
    if _is_of_table(glass):
        return {"glass": glass.name}
    arguments = _arguments(glass)
    if arguments["validity"] == [0.0, math.inf]:
        del arguments["validity"]
    if not glass.name:
        del arguments["name"]
    return arguments


def _is_of_table(glass: Sellmeier) -> bool:
    """Whether reading its name gives the same glass."""
    try:
        published = named_glass(glass.name)
    except ValueError:
        return False
    return _arguments(published) == _arguments(glass)


def _arguments(module: Any) -> dict[str, Any]:
    """The fields of a module as TOML values; those that are modules themselves are left out."""
    values = {field.name: getattr(module, field.name) for field in dataclasses.fields(module)}
    return {
        name: value if isinstance(value, str) else np.asarray(value).tolist()
        for name, value in values.items()
        if not dataclasses.is_dataclass(value)
    }
