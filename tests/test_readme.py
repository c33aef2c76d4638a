"""Every command in README works as it stands there, in order, and every picture and path that it names exists."""

import re
import tomllib
from pathlib import Path

from conftest import readme_commands
from rangecheck_cli.main import exit_status

from rangecheck.studies import STUDIES

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text()


def test_every_command_in_readme_works_and_says_what_stands_below_it(readme_job, monkeypatch, capsys):
    monkeypatch.chdir(readme_job.folder)
    commands = readme_commands()
    assert len(commands) > 12 and any(command.said for command in commands)
    for number, command in enumerate(commands):
        arguments, said = [*command.arguments], command.said
        if number == 0:
            status, told = readme_job.status, readme_job.told
        else:
            capsys.readouterr()
            status = exit_status(arguments if said else [*arguments, "-q"])
            told = "".join(capsys.readouterr())
        # a small job's verdict may be that it is not fit; what must not happen is that a command fails
        assert status in ((0, 1) if arguments[0] in ("run", "check") else (0,)), arguments
        for line in said.splitlines():
            assert re.search(f"^{re.escape(line).replace(re.escape('...'), '.*')}$", told, re.M), line


def test_every_target_of_make_in_readme_exists():
    targets = re.findall(r"^make ([a-z]+)", README, re.M)
    assert targets
    for target in targets:
        assert re.search(f"^{target}:", (ROOT / "Makefile").read_text(), re.M), target


def test_every_python_block_in_readme_works(tmp_path, monkeypatch):
    (tmp_path / "sample_data").symlink_to(ROOT / "sample_data")
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"^```python\n(.*?)^```", README, re.S | re.M)
    assert blocks
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})


def test_every_study_of_the_table_exists():
    rows = re.findall(r"^\| ((?:`[a-z]+`(?:, )?)+) \|", README.split("rangecheck study ... -o DIR")[1].split("##")[0], re.M)
    assert {name for row in rows for name in re.findall(r"`([a-z]+)`", row)} == {*STUDIES, "job"}


def test_every_picture_in_readme_exists():
    pictures = re.findall(r"!\[[^]]*\]\(([^)]+)\)", README)
    assert pictures
    for picture in pictures:
        assert (ROOT / picture).is_file(), picture


def test_every_room_of_the_map_exists():
    rows = re.findall(r"^\| (`[^|]+`) \|", README.split("## The map of the code")[1], re.M)
    rooms = [room for row in rows for room in re.findall(r"`([a-z_]+)/?`", row)]
    there = {path.stem for path in (ROOT / "rangecheck").iterdir() if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert {*rooms} - {"cli"} == there - {"__init__"} and len(rooms) == len({*rooms})
    for room in rooms:
        place = ROOT / "cli" if room == "cli" else ROOT / "rangecheck" / room
        assert place.is_dir() or place.with_suffix(".py").is_file(), room


def test_every_package_that_may_be_installed_has_its_licence_told():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *(one for extra in project["optional-dependencies"].values() for one in extra)]
    names = {re.match(r"[\w.-]+", one)[0] for one in wanted}
    told = README.split("## Dependencies and their licences")[1].split("\n## ")[0]
    assert len(names) > 25 and {name for name in names if not re.search(rf"\b{re.escape(name)}\b", told)} == set()
