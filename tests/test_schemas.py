"""Every JSON document has a published schema that real documents keep and that refuses what it does not know. That the documents of all
other tests keep theirs is looked at as they are made (conftest.py)."""

import json
import re
import tomllib
from pathlib import Path

import pytest
import schemas_kept
from jsonschema import Draft202012Validator
from rangecheck_cli.main import exit_status

from rangecheck.config import load_settings
from rangecheck.pipeline.documents import CONFIGURATION, DIALECT, schemas

ROOT = Path(__file__).resolve().parent.parent
#: a member of NPZ files, not a document; what is written over by its own name; and a document within another
NO_DOCUMENTS = {"scan", "story", "printing"}


@pytest.mark.parametrize("name", schemas())
def test_a_schema_is_one_and_says_what_it_is_of(name):
    schema = schemas()[name]
    assert schema["$schema"] == DIALECT and schema["description"]
    Draft202012Validator.check_schema(schema)


def test_every_document_that_the_source_names_has_a_schema():
    source = "\n".join(path.read_text() for folder in ("rangecheck", "cli") for path in (ROOT / folder).rglob("*.py"))
    named = {*re.findall(r'document\(\s*"([a-z-]+)"', source), *re.findall(r'"rangecheck/([a-z-]+)/1"', source)}
    assert len(named) > 20
    assert named - NO_DOCUMENTS == {*schemas()} - {CONFIGURATION}


def test_a_document_with_an_unknown_key_a_missing_one_or_another_kind_is_refused(capsys):
    assert exit_status(["explain", "open-edges", "--json"]) in (0, 2)
    capsys.readouterr()
    exit_status(["doctor", "--json", "-q"])
    document = json.loads(capsys.readouterr().out)
    assert schemas_kept.complaint(document) is None
    assert "colour" in schemas_kept.complaint(document | {"colour": "red"})
    assert "version" in schemas_kept.complaint({key: value for key, value in document.items() if key != "version"})
    assert "fit" in schemas_kept.complaint(document | {"fit": 3.5})
    row = document["checks"][0] | {"colour": "red"}
    assert "colour" in schemas_kept.complaint(document | {"checks": [row]})


def test_the_manifests_of_the_sample_scans_keep_their_schema(sample_data):
    for path in (sample_data / "scans.json", sample_data / "frontal" / "scans.json"):
        document = json.loads(path.read_text())
        assert schemas_kept.named(document) == "scans" and schemas_kept.complaint(document) is None
        document["scans"][0]["colour"] = "red"
        assert schemas_kept.complaint(document) is not None


@pytest.mark.parametrize("path", sorted((ROOT / "configs" / "jobs").glob("*.toml")), ids=lambda path: path.stem)
def test_every_preset_is_a_configuration(path):
    assert schemas_kept.complaint(tomllib.loads(path.read_text()), CONFIGURATION) is None


@pytest.mark.parametrize(
    "wrong", [{"turntable": {"framez": 7}}, {"turntable": {"frames": 0}}, {"light": {"model": "guess"}}, {"colour": "red"}]
)
def test_what_loading_refuses_the_editor_marks(wrong):
    assert schemas_kept.complaint(wrong, CONFIGURATION) is not None


def test_a_new_settings_file_names_the_schema_beside_it(capsys, tmp_path):
    file = tmp_path / "job.toml"
    assert exit_status(["init", "-o", str(file), "-q"]) == 0
    first, text = file.read_text().split("\n", 1)
    schema = json.loads((tmp_path / first.removeprefix("#:schema ./")).read_text())
    assert schema == json.loads(json.dumps(schemas()[CONFIGURATION]))
    uncommented = tomllib.loads(re.sub(r"^# (\w+ = )", r"\1", text, flags=re.MULTILINE))
    assert schemas_kept.complaint(uncommented, CONFIGURATION) is None and len(uncommented) > 5
    said = capsys.readouterr()
    assert exit_status(["init", "-o", str(file), "-q"]) == 2, said


def test_resolved_settings_are_a_configuration_but_for_what_is_unset():
    settings = load_settings("fine").model_dump(mode="json")
    assert schemas_kept.complaint(settings, CONFIGURATION) is None
    assert schemas_kept.complaint({"schema": "rangecheck/settings/1", **settings}) is None


def test_the_command_lists_and_prints_them(capsys):
    assert exit_status(["schema", "-q"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == len(schemas())
    assert exit_status(["schema", "run", "-q"]) == 0
    assert json.loads(capsys.readouterr().out)["title"] == "rangecheck/run/1"
    assert exit_status(["schema", "runn", "-q"]) == 2
    assert "did you mean run?" in capsys.readouterr().err
