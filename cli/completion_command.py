"""rangecheck completion"""

import click

from .common import common

WHERE = {
    "bash": "rangecheck completion bash > ~/.local/share/bash-completion/completions/rangecheck",
    "zsh": "rangecheck completion zsh > ~/.zfunc/_rangecheck    (with ~/.zfunc in fpath, before compinit)",
    "fish": "rangecheck completion fish > ~/.config/fish/completions/rangecheck.fish",
}


@click.command("completion", short_help="Print the script that lets a shell complete commands and options.")
@click.argument("shell", metavar="bash|zsh|fish", type=click.Choice(list(WHERE)))
@common()
def command(shell, reporter):
    """Print the script that lets a shell complete commands and options.

    \b
    bash  rangecheck completion bash > ~/.local/share/bash-completion/completions/rangecheck
    zsh   rangecheck completion zsh > ~/.zfunc/_rangecheck    (with ~/.zfunc in fpath, before compinit)
    fish  rangecheck completion fish > ~/.config/fish/completions/rangecheck.fish
    """
    from click.shell_completion import get_completion_class

    from rangecheck.pipeline.outcome import Outcome, document

    from .main import cli

    kind = get_completion_class(shell)
    assert kind is not None
    script = kind(cli, {}, "rangecheck", "_RANGECHECK_COMPLETE").source()
    return Outcome(document("completion", shell=shell, script=script, put_it=WHERE[shell]), [script])
