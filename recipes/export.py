"""`playslot export run=RUN out=DIR [export.repo=user/name]`: a trained policy as a folder that LeRobot loads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.methods import METHODS
from playslot_rl.errors import ConfigError, OutputError
from playslot_rl.recipes import evaluate
from playslot_rl.runs.opening import require_no_goal


def main(config: ExperimentConfig) -> None:
    """Write the policy of `config.run` to the new folder `config.out`, and push it where `config.export.repo` is given.

    A folder that holds this very policy already keeps it; its card has the newest results, unless it was edited, and it
    is pushed where a push is asked for: so the same command is typed again after a kill or a push that failed, a
    HubError.
    """
    run, folder = evaluate.run_with_policy(replace(config, out="")), Path(config.out)
    if not config.out or folder.resolve() == Path(config.run).resolve():
        raise ConfigError("out: got nothing or the run itself, expected a new folder, such as out=policies/press")
    require_no_goal(config, "export")
    if not METHODS[config.method].imagines:
        raise ConfigError(f"run={config.run}: got a run of method={config.method}, expected one of PlaySlot")
    from playslot_rl.sharing.folder import is_model_folder
    from playslot_rl.sharing.run import export_run, read_source, renew_exported

    source = read_source(run)
    if is_model_folder(folder):
        renewed = renew_exported(run, folder, config, source)
        print(f"policy: {folder} is there already, exported before{'; its card is new' * renewed}", flush=True)
    elif folder.exists() or folder.is_symlink():
        raise OutputError(f"out={folder}: got something that is there already, expected a new folder: choose another")
    else:
        export_run(run, folder, config, source)
        print(f"policy: {folder}", flush=True)
    if config.export.repo:
        from playslot_rl.hub.push import push_policy

        want = config.export
        result = push_policy(folder, want.repo, private=want.private, branch=want.branch or None, tag=want.tag or None)
        print("\n".join(result.lines()), flush=True)
