"""The `playslot` command: a thin front of the recipes.

Every sub-command is one module of `playslot_rl.recipes` (except `doctor`); its arguments are `key=value` overrides.
Exit codes: 0 done, 1 an error of the run, 2 bad arguments, 130 interrupted.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import textwrap
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NoReturn

from playslot_rl import __version__
from playslot_rl.errors import DEBUG, ConfigError, PeerError, explain


@dataclass(frozen=True)
class Command:
    """One sub-command: what `--help` says about it."""

    summary: str
    details: str
    examples: tuple[str, ...]


COMMANDS: Final[dict[str, Command]] = {
    "collect": Command(
        "record episodes into a LeRobot v3.0 data set",
        "Records `episodes` episodes of the `random` or the `expert` policy with several worker processes. Episodes "
        "go to a journal first: after a kill the same command carries on. The data depend on the seed, not on workers.",
        (
            "playslot collect policy=random episodes=400 out=data/random",
            "playslot collect policy=expert episodes=150 seed=5 workers=2 out=data/expert",
            "playslot collect policy=random episodes=400 collector.backend=ray workers=2 out=data/random",
            "playslot collect env=grid_shapes episodes=1000 out=data/shapes",
        ),
    ),
    "convert": Command(
        "turn Sketchy, as published, into LeRobot v3.0 data sets",
        "Reads the human demonstrations of an extracted Sketchy download (data.root) and writes OUT/train and OUT/eval "
        "with the paper's split, cameras and frame size. An error or a kill leaves no OUT.",
        (
            "playslot convert env=sketchy data.root=downloads/sketchy out=data/sketchy",
            "playslot convert env=sketchy data.root=downloads/sketchy data.camera=front_left episodes=10 out=data/few",
        ),
    ),
    "train-slots": Command(
        "stage 1: SAVi, object slots from unlabelled videos",
        "Trains SAVi on the frames of any LeRobot v3.0 data set with a camera. The same command resumes after a kill.",
        ("playslot train-slots preset=compact data.root=data/random,data/expert out=runs/mine",),
    ),
    "train-dynamics": Command(
        "stage 2: latent actions (InvDyn) and the predictor (cOCVP)",
        "Trains inverse dynamics and the predictor on the slots of a run's frozen SAVi; no actions are read.",
        (
            "playslot train-dynamics run=runs/mine data.root=data/random,data/expert",
            "playslot train-dynamics run=runs/mine dynamics.steps=5000",
        ),
    ),
    "train-policy": Command(
        "stage 3: latent policy, action decoder and slot oracle from demonstrations",
        "Clones latent actions from demo videos; only `behaviour.labelled_demos` of them lend their real actions to "
        "the action decoder. run=pretrained uses the shipped world model.",
        (
            "playslot train-policy run=runs/mine data.demos=data/expert",
            "playslot train-policy run=pretrained data.demos=data/expert behaviour.labelled_demos=20 out=runs/few",
        ),
    ),
    "train-baseline": Command(
        "one of the methods PlaySlot is compared with, as a run of its own",
        "Trains method=slot_oracle, slot_bc, resnet_oracle, resnet_bc, lapo, caddy_policy, caddy_oracle, dreamer or "
        "sold (docs/baselines.md) into out=; `playslot evaluate run=OUT` then measures it as it does PlaySlot. Or one "
        "that predicts videos: svg, caddy, slotformer or ocvp_seq (docs/video.md; `playslot compare-video` scores it). "
        "run= is the world model whose slots slot_oracle, slot_bc, sold, slotformer and ocvp_seq build on; settings "
        "come from env= and preset=, not from that run. demos=N takes the first N demonstrations.",
        (
            "playslot train-baseline method=slot_oracle run=pretrained data.demos=data/expert demos=50 out=runs/oracle",
            "playslot train-baseline method=lapo data.root=data/random data.demos=data/expert out=runs/lapo",
            "playslot train-baseline method=dreamer env=block_reach out=runs/dreamer",
            "playslot train-baseline method=svg data.root=data/random out=runs/svg",
        ),
    ),
    "evaluate": Command(
        "success rate in simulation (closed loop) or in imagination (open loop)",
        "Evaluates a fixed list of held-out seeds, one episode each, and writes "
        "RUN/evaluation/PROTOCOL/eval_info.json. A run on GridShapes has no policy: its slot masks and latent actions "
        "are scored against the known objects and moves.",
        (
            "playslot evaluate run=runs/mine protocol=simulation episodes=50",
            "playslot evaluate run=runs/mine protocol=imagination episodes=50 seed=3",
            "playslot evaluate run=runs/shapes episodes=100",
        ),
    ),
    "inspect": Command(
        "report card of a world model: are its slots and latent actions any good?",
        "Measures a run's world model on held-out episodes of a LeRobot data set, and says of each number what is good "
        "and what is bad: codes and directions in use, the real action recovered by probes with controls, transfer "
        "between episodes, constancy of the prototypes, sensitivity to the latent, health of the slots. Writes "
        "RUN/inspect/inspect.json and a page; episodes= is how many episodes are looked at (200).",
        (
            "playslot inspect run=runs/mine data.root=data/random",
            "playslot inspect run=pretrained/block_push_easy data.root=data/expert out=runs/check",
        ),
    ),
    "plan": Command(
        "reach goal images by searching over latent actions, beside random actions and the latent policy",
        "Model-predictive control in imagination, executed in the simulator by the action decoder. planner= is cem, "
        "mppi, gradient, prototypes or all; proposal= is none, policy (begin with the latent policy's rollout) or all. "
        "Goals are frames of the expert's held-out episodes: the solved one (plan.goals=solved) and the one 25 "
        "environment steps ahead (plan.goals=ahead, stable-worldmodel's protocol); both by default. Writes "
        "RUN/planning/GOALS/METHOD/eval_info.json with pictures, and the table RUN/planning/planning.md.",
        (
            "playslot plan run=runs/mine planner=cem proposal=policy episodes=20",
            "playslot plan run=pretrained planner=all proposal=all plan.seconds=1 episodes=20 out=runs/plan",
        ),
    ),
    "export": Command(
        "a trained policy as a folder that LeRobot loads, with a model card; also to the Hub",
        "Writes config.json, model.safetensors (world model, policy and action decoder), LeRobot's processors and a "
        "model card into a new folder. With `export.repo=user/name` the folder is pushed to the Hugging Face Hub too; "
        "export.private, export.branch and export.tag say how.",
        (
            "playslot export run=runs/demo out=policies/press",
            "playslot export run=runs/demo out=policies/press export.repo=me/press export.private=true",
        ),
    ),
    "play": Command(
        "steer the imagined future of a scene, in the browser",
        "Opens a page on this machine (127.0.0.1) and prints its address: start from a frame of the run's data, of "
        "data.root, of a fresh simulator episode or from a picture; steer by prototypes and variability, freeze, "
        "remove and swap slots, go back and branch, hand over to the policy, see the decoded actions in the simulator "
        "beside it, and record it all. Recordings go to RUN/play, to runs/play for a shipped model, or to OUT/play. "
        "play.show=true opens the browser. Ctrl-C ends it.",
        (
            "playslot play run=pretrained",
            "playslot play run=pretrained/block_push_easy data.root=data/expert port=8090",
            "playslot play run=runs/mine play.show=true",
        ),
    ),
    "pipeline": Command(
        "all stages from nothing: data, three trainings, evaluation, report",
        "Runs every stage and skips the finished ones, so the same command carries on after a stop.",
        (
            "playslot pipeline preset=compact env=button_press out=runs/mine",
            "playslot pipeline preset=smoke out=runs/smoke",
        ),
    ),
    "adopt": Command(
        "any LeRobot data set with a camera becomes a world model to play with",
        "Looks at the set, chooses frame size, stride, slots and prototypes by short trainings and says why, trains "
        "SAVi and dynamics within `minutes`, and writes the report card. No action is needed. The same command carries "
        "on after a kill; choices are in OUT/adopt.json.",
        (
            "playslot adopt data.root=data/mine out=runs/mine",
            "playslot adopt data.root=data/mine data.camera=observation.images.top minutes=30 out=runs/mine",
        ),
    ),
    "compare": Command(
        "methods side by side: success against demonstrations, table and plot",
        "Trains and evaluates every method with every number of demonstrations and every seed, on the same held-out "
        "episodes, and writes OUT/comparison.json, .md, .png and .svg. What is done is reused, so the same command "
        "carries on after a stop and tries what failed again. Here demos=, labels=, seeds= and methods= are lists; "
        "labels= makes it a table by labelled demonstrations, beside slot_bc and resnet_bc on these alone. The world "
        "model is run=, or trained once into OUT/world_model; data are data.root and data.demos, or recorded once "
        "into OUT/data. Jobs run one after the other, or by a Hydra launcher: hydra.launcher=joblib, submitit_local, "
        "submitit_slurm or ray, with its own keys as hydra.launcher.KEY=VALUE.",
        (
            "playslot compare run=pretrained demos=10,50,100,150 seeds=0,1,2 out=runs/comparison",
            "playslot compare run=pretrained demos=150 labels=2,5,25 methods=playslot,lapo,slot_bc out=runs/labels",
            "playslot compare env=block_push_easy methods=playslot,slot_oracle demos=100,600 seeds=0 out=runs/blocks",
            "playslot compare run=pretrained hydra.launcher=joblib hydra.launcher.n_jobs=2 out=runs/comparison",
        ),
    ),
    "compare-video": Command(
        "video predictors side by side: PSNR, SSIM and LPIPS on held-out clips, table, curves and pictures",
        "Trains every model with every seed on the same clips, and predicts the same held-out ones, of any LeRobot "
        "data set with a camera (data.root=) or of videos recorded once into OUT/data. Writes OUT/video.json, .md, "
        ".png, .svg and sheets of frames. What is done is reused, so the same command carries on after a stop. Here "
        "seeds= and methods= are lists; compare_video.budget_minutes= gives every training the same time. SAVi is "
        "run=, or trained once into OUT/world_model. Jobs run one after the other, or by a Hydra launcher, as those of "
        "compare.",
        (
            (
                "playslot compare-video env=block_push preset=compact methods=svg,caddy,slotformer,ocvp_seq,playslot "
                "seeds=0 run=pretrained out=runs/video"
            ),
            "playslot compare-video env=video data.root=data/mine compare_video.budget_minutes=15 out=runs/video",
        ),
    ),
    "demo": Command(
        "the main job with the shipped world model, in minutes",
        "Collects fresh expert demos, trains the policy on their videos and the action decoder on the labels of a "
        "third of them, evaluates under both protocols and writes a report under runs/demo/ (or out=).",
        ("playslot demo", "playslot demo seed=5 out=runs/demo-1"),
    ),
    "bench": Command(
        "speed of this machine, as ratios: training steps, rollout, sampling, rendering",
        "Times the fast paths against the plain ones in one run, medians over repeats. Leave the machine idle.",
        ("playslot bench", "playslot bench --json bench.json"),
    ),
    "doctor": Command(
        "what works on this machine, and the cure for what does not",
        "Checks Python, torch and device, the GL backend by rendering a frame, PyAV and FFmpeg, disk, cores and cache "
        "folders. Exits with 1 if something essential fails.",
        ("playslot doctor",),
    ),
}

SEVERAL: Final = ("train-slots", "train-dynamics", "train-policy", "train-baseline")
"""Commands that torchrun and accelerate launch may start on several processes."""
ANEW: Final = ("inspect", "plan", "play", "bench", "doctor", "dataset", "cache")
"""Commands that start over when they are typed again."""
INTERRUPTED: Final = 130
OWN_PATIENCE_S: Final = 1.0
PEER_PATIENCE_S: Final = 5.0
"""How long a process waits for another one's line: with an error of its own, and where it lost the other one."""

GROUPS: Final = {
    "dataset": "data sets: info, verify, repair, merge, split, viz, push, pull",
    "cache": "decoded frames and parsed slots on disk: list, clear",
}
"""Commands with actions and options of their own instead of `key=value`."""

KEYS_HELP: Final = """common keys (any key of playslot_rl/config works, with dots: slots.optim.lr=5e-4):
  env=button_press      the task
  preset=compact        sizes and schedule: smoke (seconds, for tests), compact (two CPU cores), paper (one GPU)
  policy=expert         collector policy: random or expert
  episodes=N            episodes to collect or to evaluate
  seed=0                seed of collection, training or evaluation
  workers=0             collector processes; 0 means one per core
  out=DIR               folder to write
  data.root=DIR[,DIR]   LeRobot v3.0 data set(s) of videos, DIR:2,DIR:1 with weights; data.demos=DIR for demonstrations
  run=DIR               run folder to go on from, with its stored config; `pretrained` is the shipped model
  demos=N               train-policy, train-baseline: the first N demonstrations; compare: a list of numbers
  labels=N,...          compare: numbers of labelled demonstrations
  protocol=simulation   evaluation protocol: simulation, imagination, replay (latents of the expert's videos) or slots

environment variables: PLAYSLOT_DEBUG=1 shows tracebacks, PLAYSLOT_CACHE=DIR moves the caches,
MUJOCO_GL chooses the GL backend (egl by default on Linux)."""


class _Parser(argparse.ArgumentParser):
    """Bad arguments end with one line and exit code 2."""

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
        epilog=f"commands:\n{lines}\n\n`playslot COMMAND --help` explains one of them.\n\n{KEYS_HELP}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"playslot {__version__}")
    parser.add_argument("command", choices=[*COMMANDS, *GROUPS], metavar="COMMAND", help="one of the commands below")
    return parser


def _command_parser(name: str) -> argparse.ArgumentParser:
    command = COMMANDS[name]
    examples = "\n".join(f"  {example}" for example in command.examples)
    flag = " [--json FILE]" if name == "bench" else ""
    parser = _Parser(
        prog=f"playslot {name}",
        usage=f"playslot {name} [key=value ...]{flag}",
        description=f"{command.summary}\n\n{textwrap.fill(command.details, 100)}",
        epilog=f"examples:\n{examples}\n\n{KEYS_HELP}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="changes one value of the config")
    if name == "bench":
        parser.add_argument("--json", type=Path, metavar="FILE", help="also write the figures to FILE")
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: arguments without the program's name; None reads `sys.argv`.

    Returns:
        The exit code. `--help`, `--version` and bad usage raise `SystemExit`, as argparse does.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if not arguments:
        _top_parser().print_help()
        return 2
    name = arguments[0]
    if name in {*COMMANDS, *GROUPS} - {*SEVERAL} and (code := _alone(name)):
        return code
    if name in GROUPS:
        group = importlib.import_module(f"playslot_rl.recipes.{name}")
        options = group.parser(_Parser).parse_args(arguments[1:])
        return _guarded(f"{name} {options.action}", lambda: group.run(options))
    if name not in COMMANDS:
        # Ends here unless it is --help or --version: the rest of the line belongs to no known command.
        _top_parser().parse_args(arguments[:1])
    options = _command_parser(name).parse_intermixed_args(arguments[1:])
    return _guarded(name, lambda: _run(name, options))


def _alone(name: str) -> int:
    """Refuse several processes; 0 where there is one."""
    from playslot_rl.processes import launched

    if launched().world == 1:
        return 0
    return _fail(
        name,
        f"got {launched().world} processes, expected one: only {', '.join(SEVERAL)} run on several; start this command "
        "without torchrun or accelerate launch",
        1,
    )


def _run(name: str, options: argparse.Namespace) -> int:
    from playslot_rl.config.compose import compose

    try:
        config = compose(options.overrides, name)
    except ConfigError as error:
        if _debugging():
            raise
        return _fail(name, str(error), 2)
    # Before anything imports mujoco, which needs a display by default; the same backend everywhere, the same frames.
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")
    if name == "doctor":
        from playslot_rl import doctor

        return doctor.main(config)
    from playslot_rl import processes
    from playslot_rl.config.weights import data_roots, is_remote
    from playslot_rl.envs.rendering import import_mujoco
    from playslot_rl.storage.folders import require_outside

    read = [root.path for text in (config.data.root, config.data.demos) for root in data_roots(text)]
    written = {"out=": config.out, "data.cache=": config.data.cache, "--json ": getattr(options, "json", None)}
    for key, place in written.items():
        if place and place != config.run:
            require_outside(place, [root for root in read if not is_remote(root)], key)
    if processes.launched().world > 1:
        processes.start(config.device)
    import_mujoco()  # torchrl imports it too, and would fail without our cure
    recipe = importlib.import_module(f"playslot_rl.recipes.{name.replace('-', '_')}")
    if name == "bench":
        recipe.main(config, json_path=options.json)
    else:
        recipe.main(config)
    processes.stop()
    return 0


def _guarded(name: str, run: Callable[[], int]) -> int:
    """Turn every error into one line and an exit code, or show it whole where `PLAYSLOT_DEBUG=1`."""
    try:
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
        if _debugging():
            raise
        return _fail(name, explain(error), 1)


def _debugging() -> bool:
    return os.environ.get(DEBUG, "") not in ("", "0")


def _fail(name: str, message: str, code: int, patience_s: float = OWN_PATIENCE_S) -> int:
    """Print one line. Of several processes the first one with an error of its own does: what all of them got is said by
    rank 0, and the others are ended by the launcher while they wait, or find it said.
    """
    from playslot_rl.processes import claim, launched

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
