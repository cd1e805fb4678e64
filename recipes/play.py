"""`playslot play run=RUN|pretrained [data.root=SET] [port=]`: an imagined future to play with, in the browser."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig
from playslot_rl.errors import ConfigError, DataError
from playslot_rl.runs import Run
from playslot_rl.runs.opening import SAME_TASK, require_task
from playslot_rl.runtime.devices import open_device

if TYPE_CHECKING:
    from playslot_rl.play.starts import RecordedStarts, SimulatedStarts
    from playslot_rl.play.studio import Studio
    from playslot_rl.world_model import Agent, WorldModel


def main(config: ExperimentConfig) -> None:
    """Serve the page until Ctrl-C."""
    if importlib.util.find_spec("nicegui") is None:
        raise ConfigError("play: got no NiceGUI, expected the extra `play`: make setup, or pip install nicegui==3.18.0")
    from playslot_rl.play.gate import Gate
    from playslot_rl.play.server import choose_port, serve

    choose_port(config.port)  # one that is taken is refused before the model is loaded
    studio = open_studio(config)
    gate = Gate(choose_port(config.port))  # again: loading took seconds, in which another may have taken it
    print(f"{studio.title}: {gate.address}  (Ctrl-C ends it; recordings go to {studio.out})", flush=True)
    serve(studio, gate, config.play.show)
    print("stopped", flush=True)


def open_studio(config: ExperimentConfig) -> Studio:
    """The model of `config.run` and the places to start from."""
    from playslot_rl.api import load
    from playslot_rl.play.studio import Studio
    from playslot_rl.sharing.folder import is_model_folder

    if not config.run:
        raise ConfigError("run: got nothing, expected a run or a pretrained model, such as run=pretrained")
    run = Run.of(config)
    model = load(run, str(open_device(config.device, config.threads)), config.seed)
    world = model.world_model
    recorded, simulated = recorded_starts(config, run, world, model.agent), simulated_starts(config, world)
    if recorded is None and simulated is None:
        print("no data set and no simulator to start from: upload a picture, or give data.root=", flush=True)
    kept = bool(config.out) and not is_model_folder(Path(config.out))  # nothing is written into an exported policy
    out = Path(config.out if kept else "runs") / "play"
    return Studio(
        world, model.agent, recorded, simulated, out, config.run, config.play.fps,
        squeezes=config.data.resize, horizon=predicted_frames(run), camera=run_camera(config, recorded),
    )  # fmt: skip


def predicted_frames(run: Run) -> int:
    """Steps that the run's predictor was trained to predict; 0 for an exported policy, which does not say it."""
    from playslot_rl.config import DynamicsStageConfig
    from playslot_rl.sharing.folder import is_model_folder

    if is_model_folder(run.folder):
        return 0
    return run.stage("dynamics").group(DynamicsStageConfig, "dynamics").predicted_frames


def run_camera(config: ExperimentConfig, recorded: RecordedStarts | None) -> str:
    """The feature that the run's frames come from, as far as it is known; of several cameras the first."""
    from playslot_rl import keys

    if recorded is not None:
        return recorded.source.camera.split(",")[0]
    named = config.data.camera.split(",")[0].strip()
    if not named:
        return keys.FEATURE_IMAGE
    return named if "." in named else f"observation.images.{named}"


def simulated_starts(config: ExperimentConfig, world: WorldModel) -> SimulatedStarts | None:
    """Fresh episodes of the run's task, where it has a simulator."""
    from playslot_rl.envs import ENVIRONMENTS, task_metadata
    from playslot_rl.evaluation.held_out import first_seed
    from playslot_rl.play.starts import SimulatedStarts, task_maker

    if config.env.name not in ENVIRONMENTS:
        return None
    require_task(config, world.env, SAME_TASK[2:])
    metadata = task_metadata(config.env)
    fps = metadata["control_hz"] / config.acting.frame_skip
    maker = task_maker(config.acting, config.render)
    return SimulatedStarts(world, maker, fps, metadata["task"], first_seed(config, config.seed))


def recorded_starts(
    config: ExperimentConfig, run: Run, world: WorldModel, agent: Agent | None
) -> RecordedStarts | None:
    """Frames of `data.root`, or of the data sets that the run names and that are on this machine."""
    from playslot_rl.data.weighted import open_configured
    from playslot_rl.envs import ENVIRONMENTS
    from playslot_rl.evaluation.held_out import data_folders
    from playslot_rl.play.starts import RecordedStarts, task_maker
    from playslot_rl.sharing.folder import is_model_folder

    known = bool(run.pretrained) or is_model_folder(run.folder)
    named = data_folders(config, None if known else run.folder)
    found = [root for root in named if (root / "meta" / "info.json").is_file()]
    missing = [root for root in named if root not in found]
    # A pretrained model or an exported policy names no data set, so the user did; a run names those of its training.
    typed = known or config.data.root != run.config.data.root
    if missing and (typed or (not found and config.env.name not in ENVIRONMENTS)):
        raise DataError(f"data.root={missing[0]}: got no data set, expected a LeRobot v3.0 one: check data.root=")
    if named and not found:
        print(f"the run's data sets are not on this machine ({named[0]}): the simulator makes the starts", flush=True)
    if not found:
        return None
    env = replace(config.env, image_size=world.env.image_size)
    source = open_configured(replace(config, env=env), found)
    simulator = agent is not None and config.env.name in ENVIRONMENTS
    maker = task_maker(config.acting, config.render) if simulator else None
    return RecordedStarts(world, source, maker, config.seed)
