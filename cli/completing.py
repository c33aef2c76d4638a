"""What a shell is offered for a word that is being typed: names of what there is."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import click
from click.shell_completion import CompletionItem

if TYPE_CHECKING:
    from pydantic import BaseModel

Names = Callable[[click.Context], Iterable[str]]
Complete = Callable[[click.Context, click.Parameter, str], list[CompletionItem]]


def among(names: Names, *, or_file: bool = False) -> Complete:
    """Completes the names that begin as the word does, and files where one may stand instead."""

    def complete(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        found = sorted(name for name in names(ctx) if name.startswith(incomplete))
        # the shell's files go first: bash takes them only where nothing else fits, and forgets what came before them
        files = [CompletionItem(incomplete, type="file")] if or_file else []
        return files + [CompletionItem(name) for name in found]

    return complete


def shipped(kind: str) -> Complete:
    """Completes names of the shipped files of a kind (materials, printers, jobs, datasets), and files like them."""

    def names(ctx: click.Context) -> Iterable[str]:
        from rangecheck.files import presets_folder

        return (path.stem for path in (presets_folder() / kind).glob("*.toml"))

    return among(names, or_file=True)


def profiles(ctx: click.Context) -> Iterable[str]:
    """What scans can be judged for."""
    from typing import get_args

    from rangecheck.config import Settings

    return get_args(type(Settings().scan).model_fields["profile"].annotation)


def assignments(ctx: click.Context) -> Iterable[str]:
    """section.key= of every setting."""
    from rangecheck.config import Settings

    return (f"{key}=" for key in _keys(Settings()))


def _keys(section: BaseModel) -> Iterable[str]:
    from pydantic import BaseModel

    for name, value in section:
        if isinstance(value, BaseModel):
            yield from (f"{name}.{key}" for key in _keys(value))
        else:
            yield name


def schemas(ctx: click.Context) -> Iterable[str]:
    """Every JSON Schema."""
    from rangecheck.pipeline.documents import schemas

    return schemas()


def codes(ctx: click.Context) -> Iterable[str]:
    """Every finding that can be explained."""
    from rangecheck.files import presets_folder, read_toml

    return read_toml(presets_folder() / "findings.toml")


def studies(ctx: click.Context) -> Iterable[str]:
    """Every study."""
    from rangecheck.studies import STUDIES

    return (*STUDIES, "job")


def parts(ctx: click.Context) -> Iterable[str]:
    """The parts of the study that stands before on the line; none where it does not exist, or cannot be made here."""
    from rangecheck.errors import RangecheckError
    from rangecheck.pipeline.inspect import study_parts

    # an option that still lacks its value ends click's reading of the line: what stood before is left over
    study = ctx.params.get("what") or next(iter(ctx.args), "")
    try:
        return study_parts(study)
    except (RangecheckError, ImportError):
        return ()
