"""Before the work: a commented settings file to start from, and the shapes of all documents."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from rangecheck.config import Settings
from rangecheck.errors import OutputError, SettingError
from rangecheck.files import write_bytes, write_json
from rangecheck.pipeline.documents import CONFIGURATION, schemas
from rangecheck.pipeline.outcome import Outcome, document
from rangecheck.pipeline.views import refuse_existing


def init(out: str, *, force: bool) -> Outcome:
    """Write every setting with its default, range and meaning to `out`, each line a comment until it is changed, and beside it the JSON
    Schema by which editors complete and check it."""
    path = Path(out)
    if path.suffix.lower() != ".toml":
        raise OutputError(out, "must end in .toml")
    described = path.with_suffix(".schema.json")
    for target in (path, described):
        refuse_existing(target, force)
    # the first line is how Taplo, and with it most editors, find the schema of a TOML file
    lines = [
        f"#:schema ./{described.name}",
        "# Settings of rangecheck. Take the # away from a line to change it; what stays a comment keeps its default.",
        "",
    ]
    lines += _section(Settings, "")
    write_json(described, schemas()[CONFIGURATION], force=force)
    try:
        write_bytes(path, ("\n".join(lines) + "\n").encode(), force=force)
    except OutputError:
        described.unlink(missing_ok=True)  # alone it is of no use, and would stand in the way of the next try
        raise
    return Outcome(
        document("init", output=out, json_schema=described),
        [
            f"{out}: every setting with its default",
            f"{described}: what editors complete and check it by",
            f"use it with: rangecheck run SCANS --config {out} --out DIR",
        ],
    )


def schema(name: str | None) -> Outcome:
    """The JSON Schema of a document, or of the configuration; without a name, those that there are. Raises SettingError."""
    known = schemas()
    if name is None:
        about = {key: str(found.get("description", found["title"])) for key, found in known.items()}
        width = max(map(len, known))
        return Outcome(document("schema", names=about), [f"{key:<{width}}  {said}" for key, said in about.items()])
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        hint = f"did you mean {near[0]}?" if near else "`rangecheck schema` lists them"
        raise SettingError(f"there is no schema {name!r}; {hint}", key=name)
    return Outcome(known[name], [json.dumps(known[name], indent=1)])


def _section(model: type[BaseModel], name: str) -> Iterator[str]:
    """The lines of a section: its own settings first, then the sections within."""
    below = []
    if name:
        yield f"[{name}]"
    for key, field in model.model_fields.items():
        default = field.get_default(call_default_factory=True)
        if isinstance(default, BaseModel):
            below.append((key, type(default)))
            continue
        told = ". ".join(filter(None, (field.description, _range_of(field))))
        if told:
            yield f"# {told}"
        yield f"# {key} = {_toml(default)}" if default is not None else f"# {key} ="
    for key, section in below:
        yield ""
        yield from _section(section, f"{name}.{key}" if name else key)


def _range_of(field: FieldInfo) -> str:
    words = {Ge: "at least", Gt: "above", Le: "at most", Lt: "below"}
    bounds = [
        f"{said} {getattr(part, kind.__name__.lower()):g}"
        for part in field.metadata
        for kind, said in words.items()
        if isinstance(part, kind)
    ]
    choices = _choices(field.annotation)
    return "; ".join(filter(None, (" and ".join(bounds), f"one of {', '.join(map(_toml, choices))}" if choices else "")))


def _choices(annotation: Any) -> tuple[Any, ...]:
    from typing import Literal, get_args, get_origin

    if get_origin(annotation) is Literal:
        return get_args(annotation)
    return next((found for part in get_args(annotation) if (found := _choices(part))), ())


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(k)} = {_toml(v)}" for k, v in value.items()) + " }" if value else "{}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return json.dumps(value)
