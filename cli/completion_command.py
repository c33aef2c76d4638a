"""rangecheck completion"""

import click

from .common import common

WHERE = {
    "bash": "rangecheck completion bash > ~/.local/share/bash-completion/completions/rangecheck",
    "zsh": "rangecheck completion zsh > ~/.zfunc/_rangecheck    (with ~/.zfunc in fpath, before compinit)",
    "fish": "rangecheck completion fish > ~/.config/fish/completions/rangecheck.fish",
}
#: what click's scripts lack: behind a comma fish is told no more of an option; zsh puts a space behind "key=", and at the second tab of a shell,
#: when the function is there already, registers it instead of calling it
LACKING = {
    "$zsh_eval_context[-1] == loadautofunc": '"$funcstack[1]" == "_rangecheck"',
    'string split ","': 'string split --max 1 ","',
    "        compadd -U -V unsorted -a completions": """        compadd -U -S "" -V unsorted -- ${(M)completions:#*=}
        compadd -U -V unsorted -- ${completions:#*=}""",
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
    for theirs, ours in LACKING.items():
        script = script.replace(theirs, ours)
    return Outcome(document("completion", shell=shell, script=script, put_it=WHERE[shell]), [script])
