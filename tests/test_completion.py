"""What the shells themselves make of the scripts that teach them the command."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.fixture
def line_completed(tmp_path, capsys):
    """The line that a shell makes of a begun one, where a tab is typed at its end."""
    from rangecheck_cli.main import exit_status

    def completed(shell: str, script: str, *begun: str) -> list[str]:
        if shutil.which(shell) is None:
            pytest.skip(f"{shell} is not installed: apt-get install {shell}")
        assert exit_status(["completion", shell]) == 0
        (tmp_path / "_rangecheck").write_text(capsys.readouterr().out)
        (tmp_path / "begin").write_text(script)
        command = tmp_path / "rangecheck"
        command.write_text(f'#!/bin/sh\nexec {sys.executable} -m rangecheck_cli "$@"\n')
        command.chmod(0o755)
        path = f"{tmp_path}:{Path(sys.executable).parent}:{os.environ['PATH']}"
        options = {"zsh": ["-f"], "fish": ["--no-config"]}[shell]
        done = subprocess.run(
            [shell, *options, "begin", *begun], cwd=tmp_path, env={**os.environ, "PATH": path, "TERM": "dumb"}, capture_output=True,
            text=True, timeout=240,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout.splitlines()

    return completed


def test_fish_is_told_all_that_an_option_means_commas_and_all(line_completed):
    fish = "source _rangecheck\nfor line in $argv; complete -C $line; end\n"
    found = line_completed("fish", fish, "rangecheck ru", "rangecheck run --set see", "rangecheck run --pres")
    assert [line.partition("\t")[0] for line in found] == ["run", "seed=", "--preset"]
    assert found[0].endswith("report.")


ZSH = r"""
zmodload zsh/zpty
zpty -b shell zsh -f -i
zpty -w shell 'PROMPT=; fpath=($PWD $fpath); autoload -U compinit; compinit -u -D; tell() { zle expand-or-complete; print -r -- "<$BUFFER>"; BUFFER= }; zle -N tell; bindkey "^X" tell; print "<rea""dy>"'
until zpty -r shell got '*<ready>*'; do :; done
for begun in "$@"; do
    zpty -w -n shell "$begun"$'\x18'
    zpty -r shell got '*<*>*'
    print -r -- "${${got##*<}%%>*}"
done
zpty -d shell
"""


def test_zsh_puts_no_space_between_a_setting_and_its_value(line_completed):
    found = line_completed("zsh", ZSH, "rangecheck run --set see", "rangecheck run --pres", "rangecheck render x --material stee")
    assert found[:2] == ["rangecheck run --set seed=", "rangecheck run --preset "]
    assert found[2].rstrip() == "rangecheck render x --material steel"
