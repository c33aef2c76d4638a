"""Settings from, in rising order of precedence: the schema's defaults, a preset, a file, key=value pairs, single options."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from rangecheck.config.schema import Settings
from rangecheck.errors import InputError, SettingError
from rangecheck.files import beside, presets_folder, read_bytes


def load_settings(
    file: str | Path | None = None,
    assignments: Iterable[str] = (),
    overrides: Mapping[str, Any] | None = None,
    preset: str | None = None,
) -> Settings:
    """Resolved settings.

    file         a TOML file, or the name of a preset in configs/jobs/ (quick, normal, fine)
    assignments  "section.key=value" with TOML values; a bare word is a string
    overrides    {"section.key": value}; None values are skipped
    preset       the name of a preset, over which the file's settings go

    Raises InputError (file) or SettingError (key, with the nearest known name)."""
    tree: dict[str, Any] = _merged(_read(preset) if preset else {}, _read(file) if file else {})
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals:
            raise SettingError(f"--set takes key=value; got {assignment!r}, for example --set turntable.frames=72", key=key)
        _put(tree, key.strip(), _value(text.strip()))
    for key, value in (overrides or {}).items():
        if value is not None:
            _put(tree, key, value)
    try:
        return Settings.model_validate(tree)
    except ValidationError as error:
        raise _explained(error, file) from None


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Both trees; where they meet, what is above."""
    return below | {
        key: _merged(below[key], value) if isinstance(value, dict) and isinstance(below.get(key), dict) else value
        for key, value in above.items()
    }


def _read(file: str | Path) -> dict[str, Any]:
    path = Path(file)
    if path.suffix != ".toml" and not path.exists():
        preset = presets_folder() / "jobs" / f"{file}.toml"
        if not preset.is_file():
            known = ", ".join(sorted(p.stem for p in (presets_folder() / "jobs").glob("*.toml")))
            raise InputError(file, f"is neither a TOML file nor a preset; presets are {known}")
        path = preset
    try:
        tree = tomllib.loads(read_bytes(path).decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(path, f"is not valid TOML ({error}); correct it and try again") from None
    light = tree.get("light")
    if isinstance(light, dict) and isinstance(light.get("materials"), list):
        light["materials"] = [
            beside(name, path.parent) if isinstance(name, str) and name.endswith(".toml") else name for name in light["materials"]
        ]
    return tree


def _value(text: str) -> Any:
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (tomllib.TOMLDecodeError, RecursionError):
        return text


def _put(tree: dict[str, Any], key: str, value: Any) -> None:
    *sections, last = key.split(".")
    for section in sections:
        below = tree.setdefault(section, {})
        if not isinstance(below, dict):
            raise SettingError(f"setting {key}: {section} is a value, not a section", key=key)
        tree = below
    tree[last] = value


def _explained(error: ValidationError, file: str | Path | None) -> SettingError:
    first = error.errors()[0]
    path = [str(p) for p in first["loc"]]
    key = ".".join(path)
    if first["type"] == "extra_forbidden":
        known = _keys_at(path[:-1])
        near = difflib.get_close_matches(path[-1], known, n=1)
        hint = f"did you mean {'.'.join([*path[:-1], near[0]])}?" if near else f"known here: {', '.join(known)}"
        message = f"setting {key} is unknown; {hint}"
    else:
        message = f"setting {key} is {first['input']!r}: {first['msg'][0].lower()}{first['msg'][1:]}"
    message = " ".join(message.split())
    return SettingError(f"{file}: {message}" if file else message, key=key)


def _keys_at(path: list[str]) -> list[str]:
    model: type[BaseModel] = Settings
    for name in path:
        annotation = model.model_fields[name].annotation if name in model.model_fields else None
        candidates = [annotation, *get_args(annotation)]
        found = next((c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)), None)
        if found is None:
            return []
        model = found
    return list(model.model_fields)
