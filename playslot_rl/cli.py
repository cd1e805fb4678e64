"""The `playslot` command: a thin front of the recipes.

Every sub-command is one module of `playslot_rl.recipes`; its arguments are `key=value` overrides.
Exit codes: 0 done, 1 an error, 2 arguments refused when they are read, 130 interrupted, 141 standard
output closed.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import os
import select
import signal
import sys
import textwrap
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NoReturn

from playslot_rl import __version__
from playslot_rl.commands import COMMANDS as COMMANDS
from playslot_rl.commands import GROUPS as GROUPS
from playslot_rl.config.plain import nearest
from playslot_rl.errors import DEBUG, ConfigError, PeerError, explain

SEVERAL: Final = ("train-slots", "train-dynamics", "train-policy", "train-baseline")
"""Commands that torchrun and accelerate launch may start on several processes."""
ANEW: Final = ("inspect", "plan", "play", "bench", "doctor", "dataset", "cache")
"""Commands that start over when they are typed again."""
INTERRUPTED: Final = 130
CLOSED: Final = 141
"""Nobody reads standard output any more: as of a program that SIGPIPE ends."""
OWN_PATIENCE_S: Final = 1.0
PEER_PATIENCE_S: Final = 5.0
"""How long a process waits for another one's line: with an error of its own, and where it lost the other one."""

ENVIRONMENT: Final = """environment variables: PLAYSLOT_DEBUG=1 shows tracebacks, PLAYSLOT_CACHE=DIR moves the caches,
MUJOCO_GL chooses the GL backend (egl by default on Linux)."""


class _Parser(argparse.ArgumentParser):
    """Bad arguments end with one line and exit code 2."""

    def _check_value(self, action: argparse.Action, value: object) -> None:
        """Also says which of the known commands or actions is the nearest."""
        known = list(action.choices or ())
        if known and value not in known:
            said = f"invalid choice: {value!r} (choose from {', '.join(map(str, known))})"
            raise argparse.ArgumentError(action, said + nearest(str(value), known))

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: error: {message}; see `{self.prog} --help`\n")


def _top_parser() -> argparse.ArgumentParser:
    width = max(map(len, COMMANDS))
    summaries = {name: command.summary for name, command in COMMANDS.items()} | GROUPS
    lines = "\n".join(f"  {name:<{width}}  {summary}" for name, summary in summaries.items())
    parser = _Parser(
        prog="playslot",
        usage="playslot COMMAND [key=value ...]",
        description="Robot behaviours from unlabelled videos: object slots, latent actions, imagination.",
        epilog=f"commands:\n{lines}\n\n`playslot COMMAND --help` explains one of them, with its keys.\n\n{ENVIRONMENT}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"playslot {__version__}")
    parser.add_argument("command", choices=[*COMMANDS, *GROUPS], metavar="COMMAND", help="one of the commands below")
    return parser


def _command_parser(name: str) -> argparse.ArgumentParser:
    from playslot_rl.config.key_help import explained

    command = COMMANDS[name]
    examples = "\n".join(f"  {example}" for example in command.examples)
    flag = {"bench": " [--json FILE]", "models": " [--json]"}.get(name, "")
    parser = _Parser(
        prog=f"playslot {name}",
        usage=f"playslot {name} [key=value ...]{flag}",
        description=f"{command.summary}\n\n{textwrap.fill(command.details, 100)}",
        epilog=f"examples:\n{examples}\n\n{explained(name, command.reads.split())}\n\n{ENVIRONMENT}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="changes one value of the config")
    if name == "bench":
        parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures to FILE")
    if name == "models":
        parser.add_argument("--json", action="store_true", help="print a list of objects")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command, of `sys.argv` where None is given, and return the exit code. `--help`, `--version` and bad usage
    raise `SystemExit`, as argparse does.
    """
    try:
        return _main(argv)
    finally:
        _unread()  # else the end of the process would complain


def _main(argv: Sequence[str] | None) -> int:
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments:
        _top_parser().print_help()
        return 2
    name = arguments[0]
    if name in {*COMMANDS, *GROUPS} - {*SEVERAL} and (code := _alone(name)):
        return code
    if name in GROUPS:
        from playslot_rl.recipes.actions import make_parser, run_action

        actions, parser = make_parser(name, _Parser)
        options = parser.parse_args(arguments[1:])
        return _guarded(f"{name} {options.action}", lambda: run_action(actions, options))
    if name not in COMMANDS:
        # Ends here unless it is --help or --version: the rest of the line belongs to no known command.
        _top_parser().parse_args(arguments[:1])
    options = _command_parser(name).parse_intermixed_args(arguments[1:])
    return _guarded(name, lambda: _run(name, options))


def _alone(name: str) -> int:
    """Refuse several processes; 0 where there is one."""
    from playslot_rl.runtime.processes import launched

    if launched().world == 1:
        return 0
    return _fail(
        name,
        f"got {launched().world} processes, expected one: only {', '.join(SEVERAL)} run on several; start this command "
        "without torchrun or accelerate launch",
        1,
    )


def _noted(message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None) -> str:
    """A warning of what was typed as a note, others as Python shows them."""
    if category is RuntimeWarning and str(message).startswith("env."):
        return f"note: {message}\n"
    return _plainly(message, category, filename, lineno, line)


_plainly: Final = warnings.formatwarning


def _run(name: str, options: argparse.Namespace) -> int:
    from playslot_rl.config.compose import compose_each

    warnings.formatwarning = _noted
    try:
        configs = compose_each(options.overrides, name)
    except ConfigError as error:
        if _debugging():
            raise
        return _fail(name, str(error), 2)
    config = configs[0]
    # Before anything imports mujoco, which needs a display by default; the same backend everywhere, the same frames.
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")
    if name == "doctor":
        from playslot_rl.recipes import doctor

        return doctor.main(config)
    if name == "models":
        from playslot_rl.recipes import models

        models.main(config, as_json=options.json)
        return 0
    from playslot_rl.config.weights import data_roots, is_remote
    from playslot_rl.envs.rendering import import_mujoco
    from playslot_rl.runtime import processes
    from playslot_rl.storage.folders import require_outside

    roots = [root.path for text in (config.data.root, config.data.demos) for root in data_roots(text)]
    read = [root for root in roots if not is_remote(root)]
    for key, place in (("out=", config.out), ("data.cache=", config.data.cache)):
        if place and place != config.run:
            require_outside(place, read, key)
    if getattr(options, "json", None):
        require_outside(options.json, read, "--json ", "file")
    if processes.launched().world > 1:
        processes.start(config.device)
    import_mujoco()  # torchrl imports it too, and would fail without our cure
    recipe = importlib.import_module(f"playslot_rl.recipes.{name.replace('-', '_')}")
    if name == "bench":
        recipe.main(config, json_path=options.json)
    else:
        recipe.main(*configs)
    processes.stop()
    return 0


def _guarded(name: str, run: Callable[[], int]) -> int:
    """Turn every error into one line and an exit code, or show it whole where `PLAYSLOT_DEBUG=1`."""
    try:
        with _terminable():
            return run()
    except KeyboardInterrupt as error:
        goes_on = "; the same command carries on from the last checkpoint or episode"
        where = str(error) or "interrupted" + ("" if name in ANEW else goes_on)
        return _fail(name, where, INTERRUPTED)
    except PeerError as error:
        if _debugging():
            raise
        return _fail(name, explain(error), 1, patience_s=PEER_PATIENCE_S)
    except Exception as error:
        if isinstance(error, BrokenPipeError) and _unread():
            return CLOSED
        if _debugging():
            raise
        return _fail(name, explain(error), 1)


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """Inside, SIGTERM, by which a cluster ends a job, is as Ctrl-C. Not of several processes, which their launcher ends
    so while they wait for each other, nor in forked ones, nor where somebody else handles it.
    """
    from playslot_rl.runtime.processes import launched

    own, before = os.getpid(), signal.getsignal(signal.SIGTERM)
    main = threading.current_thread() is threading.main_thread()
    if launched().world > 1 or before is not signal.SIG_DFL or not main:
        yield
        return

    def end(number: int, _: object) -> None:
        if os.getpid() == own:
            raise KeyboardInterrupt
        signal.signal(number, signal.SIG_DFL)
        signal.raise_signal(number)

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _unread() -> bool:
    """Whether nobody reads standard output any more, as after `| head`; then what is left for it goes nowhere."""
    try:
        said, poll = sys.stdout.fileno(), select.poll()
    except (AttributeError, OSError, ValueError):
        return False  # it is no file, or a system that cannot tell
    poll.register(said, 0)
    broken = any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))
    if broken:
        os.dup2(os.open(os.devnull, os.O_WRONLY), said)
    return broken


def _debugging() -> bool:
    return os.environ.get(DEBUG, "") not in ("", "0")


def _fail(name: str, message: str, code: int, patience_s: float = OWN_PATIENCE_S) -> int:
    """Print one line. Of several processes the first one with an error of its own does: what all of them got is said by
    rank 0, and the others are ended by the launcher while they wait, or find it said.
    """
    from playslot_rl.runtime.processes import claim, launched

    rank = launched().rank
    if rank:
        if code == INTERRUPTED:
            return code
        name = f"{name} (rank {rank})"
    if launched().world > 1:
        if rank or patience_s > OWN_PATIENCE_S:
            time.sleep(patience_s)
        if not claim("error"):
            return code
    print(f"playslot {name}: error: {message}", file=sys.stderr, flush=True)
    return code
