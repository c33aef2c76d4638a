"""Documents against their published schemas; validators are made when the first document comes."""

import functools
import json
from pathlib import Path


@functools.cache
def validators():
    """A validator for each name."""
    from jsonschema import Draft202012Validator

    from rangecheck.pipeline.documents import schemas

    return {name: Draft202012Validator(schema) for name, schema in schemas().items()}


def complaint(document, name=None):
    """What is wrong with a document, or None; its schema is that of `name`, or the one it says."""
    from jsonschema.exceptions import best_match

    name = name or named(document)
    if name not in validators():
        return f"there is no schema {name!r}"
    error = best_match(validators()[name].iter_errors(document))
    while error is not None and error.context:  # of several forms, the one that is missed by least
        by_form = [[e for e in error.context if e.schema_path[0] == form] for form in {e.schema_path[0] for e in error.context}]
        error = min(by_form, key=len)[0]
    return error and f"{name} at {'/'.join(map(str, error.absolute_path)) or 'its top'}: {error.message[:300]}"


def named(document):
    """The name in a document's schema; None where it says none of ours."""
    said = document.get("schema", document.get("info", {}) if isinstance(document.get("info"), dict) else None)
    said = said.get("schema") if isinstance(said, dict) else said
    return said.split("/")[1] if isinstance(said, str) and said.startswith("rangecheck/") else None


def require(document):
    """Fail where a document that says its schema does not keep it."""
    if isinstance(document, dict) and named(document):
        wrong = complaint(document)
        assert wrong is None, wrong


def require_text(path, content):
    """The same of a file's bytes, where they are JSON."""
    if Path(path).suffix == ".json":
        require(json.loads(content))
    elif Path(path).suffix == ".jsonl":
        for row in map(json.loads, content.splitlines()):
            wrong = complaint(row, "dataset-row")
            assert wrong is None, wrong
