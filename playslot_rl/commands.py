"""The sub-commands of `playslot`: what `--help` says about each of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

TRAINED: Final = "env preset seed out device threads data.root data logging"
"""What every training reads, beside its own groups."""
MADE: Final = "env render collect"
"""What decides which episodes are recorded."""
TASK: Final = "env render"
STAGES: Final = "model slots dynamics behaviour"


@dataclass(frozen=True)
class Command:
    """One sub-command: what `--help` says about it, in a line and in a paragraph, and what it reads: the names of the
    config's keys and groups, which `playslot_rl.config.key_help` explains.
    """

    summary: str
    details: str
    examples: tuple[str, ...]
    reads: str


COMMANDS: Final[dict[str, Command]] = {
    "collect": Command(
        "record episodes into a LeRobot v3.0 data set",
        "Records `episodes` episodes of the policy `random`, `expert` or `noisy_expert` in several processes. Episodes "
        "go to a journal first: after a kill the same command carries on. The data depend on the seed, not on workers.",
        (
            "playslot collect policy=random episodes=400 out=data/random",
            "playslot collect policy=expert episodes=150 seed=5 workers=2 out=data/expert",
            "playslot collect policy=random episodes=400 collector.backend=ray workers=2 out=data/random",
            "playslot collect env=grid_shapes episodes=1000 out=data/shapes",
        ),
        "preset policy episodes seed workers out collect.noise collect.storage collect.random_episodes "
        "collect.random_steps collect.expert_episodes collect.expert_steps collect.noisy_episodes "
        f"collect.exploration_noise logging.progress {TASK} collector",
    ),
    "convert": Command(
        "turn Sketchy, as published, into LeRobot v3.0 data sets",
        "Reads the human demonstrations of an extracted Sketchy download (data.root) and writes OUT/train and OUT/eval "
        "with the paper's split, cameras and frame size. An error or a kill leaves no OUT.",
        (
            "playslot convert env=sketchy data.root=downloads/sketchy out=data/sketchy",
            "playslot convert env=sketchy data.root=downloads/sketchy data.camera=front_left episodes=10 out=data/few",
        ),
        "env episodes out data.root data.camera env.image_size collect.storage",
    ),
    "train-slots": Command(
        "stage 1: SAVi, object slots from unlabelled videos",
        "Trains SAVi on the frames of any LeRobot v3.0 data set with a camera. The same command resumes after a kill.",
        ("playslot train-slots preset=compact data.root=data/random,data/expert out=runs/mine",),
        f"env {TRAINED} model.savi slots env.image_size render",
    ),
    "train-dynamics": Command(
        "stage 2: latent actions (InvDyn) and the predictor (cOCVP)",
        "Trains inverse dynamics and the predictor on the slots of a run's frozen SAVi; no actions are read.",
        (
            "playslot train-dynamics run=runs/mine data.root=data/random,data/expert",
            "playslot train-dynamics run=runs/mine dynamics.steps=5000",
        ),
        f"run {TRAINED} model.inverse_dynamics model.predictor dynamics",
    ),
    "train-policy": Command(
        "stage 3: latent policy, action decoder and slot oracle from demonstrations",
        "Clones latent actions from demo videos; only `behaviour.labelled_demos` of them lend their real actions to "
        "the action decoder. run=pretrained uses the pretrained one of the task.",
        (
            "playslot train-policy run=runs/mine data.demos=data/expert",
            "playslot train-policy run=pretrained data.demos=data/expert behaviour.labelled_demos=20 out=runs/few",
        ),
        f"run demos data.demos {TRAINED} model.policy model.action_decoder behaviour collect.validation_episodes",
    ),
    "train-baseline": Command(
        "one of the methods PlaySlot is compared with, as a run of its own",
        "Trains method=slot_oracle, slot_bc, resnet_oracle, resnet_bc, history_bc, act, act_state, diffusion, "
        "diffusion_state, autoencoder_bc, inverse_bc, slot_vpt, lapo, lapo_slots, laom, clam, caddy_policy, "
        "caddy_oracle, dreamer or sold into out=; `playslot evaluate run=OUT` then measures it as PlaySlot. Or one "
        "that predicts videos, svg, caddy, slotformer or ocvp_seq; `playslot compare-video` scores it "
        "(docs/explanation/methods.md). run= is the world model whose slots slot_oracle, slot_bc, slot_vpt, "
        "lapo_slots, sold, slotformer and ocvp_seq build on; settings come from env= and preset=, not from that run. "
        "demos=N takes the first N demonstrations.",
        (
            "playslot train-baseline method=slot_oracle run=pretrained data.demos=data/expert demos=50 out=runs/oracle",
            "playslot train-baseline method=lapo data.root=data/random data.demos=data/expert out=runs/lapo",
            "playslot train-baseline method=dreamer env=block_reach out=runs/dreamer",
            "playslot train-baseline method=svg data.root=data/random out=runs/svg",
        ),
        f"method run demos data.demos {TRAINED} model.policy model.action_decoder behaviour baselines "
        "env.max_steps env.frame_skip env.blocks render collect.validation_episodes",
    ),
    "evaluate": Command(
        "success in simulation (closed loop) or imagination (open loop), or the error of actions without a simulator",
        "Evaluates a fixed list of held-out seeds, one episode each, and writes "
        "RUN/evaluation/PROTOCOL/eval_info.json. protocol=actions holds the policy's actions against those of recorded "
        "demonstrations that nothing was trained on: those held out by data.held_out=, or another set, data.demos=. A "
        "run on GridShapes has no policy: its slot masks and latent actions are scored against the known objects and "
        "moves.",
        (
            "playslot evaluate run=runs/mine protocol=simulation episodes=50",
            "playslot evaluate run=runs/mine protocol=imagination episodes=50 seed=3",
            "playslot evaluate run=runs/shapes episodes=100",
            "playslot evaluate run=runs/arm protocol=actions data.demos=data/new",
        ),
        f"run method episodes seed protocol device threads {TASK} evaluation data.root data.demos",
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
        "run episodes seed out device threads data",
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
        f"run episodes seed out device threads plan {TASK} evaluation",
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
        "run out export",
    ),
    "play": Command(
        "steer the imagined future of a scene, in the browser",
        "Opens a page on this machine (127.0.0.1) and prints its address: start from a frame of the run's data, of "
        "data.root, of a fresh simulator episode or from a picture; steer by prototypes and variability, freeze, "
        "remove and swap slots, go back and branch, hand over to the policy, see the decoded actions in the simulator "
        "beside it, and record it all. Recordings go to RUN/play, to runs/play for a pretrained model, or to OUT/play. "
        "play.show=true opens the browser. Ctrl-C ends it.",
        (
            "playslot play run=pretrained",
            "playslot play run=pretrained/block_push_easy data.root=data/expert port=8090",
            "playslot play run=runs/mine play.show=true",
        ),
        f"run port seed out device threads play data {TASK} evaluation.seed_offset",
    ),
    "pipeline": Command(
        "all stages from nothing: data, three trainings, evaluation, report",
        "Runs every stage and skips the finished ones, so the same command carries on after a stop.",
        (
            "playslot pipeline preset=compact env=button_press out=runs/mine",
            "playslot pipeline preset=smoke out=runs/smoke",
        ),
        f"run episodes workers protocol {TRAINED} {MADE} collector {STAGES} evaluation",
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
        f"minutes {TRAINED} adopt model slots dynamics env.image_size",
    ),
    "compare": Command(
        "methods side by side: success against demonstrations, table and plot",
        "Trains and evaluates every method with every number of demonstrations and every seed, on the same held-out "
        "episodes, and writes OUT/comparison.json, .md, .png and .svg. What is done is reused, so the same command "
        "carries on after a stop and tries what failed again. Here demos=, labels=, seeds= and methods= are lists; "
        "labels= makes it a table by labelled demonstrations, beside slot_bc and resnet_bc on these alone, and videos= "
        "one by unlabelled videos. envs= are tasks, each compared in OUT/TASK, and a table over all. worlds= are world "
        "models, compare.block=test a fresh block of episodes. With env=video the error of actions on the last "
        "demonstrations is measured, for want of a simulator. The world model is run=, or trained once into "
        "OUT/world_model; data are data.root and data.demos, or recorded once into OUT/data. Jobs run one after the "
        "other, or by a Hydra launcher: hydra.launcher=joblib, submitit_local, "
        "submitit_slurm or ray, with its own keys as hydra.launcher.KEY=VALUE.",
        (
            "playslot compare run=pretrained demos=10,50,100,150 seeds=0,1,2 out=runs/comparison",
            "playslot compare run=pretrained demos=150 labels=2,5,25 methods=playslot,lapo,slot_bc out=runs/labels",
            "playslot compare env=block_push_easy methods=playslot,slot_oracle demos=100,600 seeds=0 out=runs/blocks",
            "playslot compare envs=metaworld/drawer-open,block_push_easy demos=100 labels=5 out=runs/tasks",
            "playslot compare env=video methods=resnet_bc,act labels=5,10 data.demos=data/arm out=runs/arm",
            "playslot compare run=pretrained hydra.launcher=joblib hydra.launcher.n_jobs=2 out=runs/comparison",
        ),
        f"env run episodes workers {TRAINED} compare {MADE} collector {STAGES} baselines evaluation",
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
        f"env run workers {TRAINED} compare_video {MADE} collector model slots dynamics baselines metrics",
    ),
    "demo": Command(
        "the main job with a pretrained world model, in minutes",
        "Collects fresh expert demos, trains the policy on their videos and the action decoder on the labels of a "
        "third of them, evaluates under both protocols and writes a report under runs/demo/ (or out=).",
        ("playslot demo", "playslot demo seed=5 out=runs/demo-1"),
        f"env episodes workers {TRAINED} {MADE} collector behaviour evaluation",
    ),
    "bench": Command(
        "speed of this machine: training steps, rollout, playing, planning, data sets, rendering",
        "Times the fast paths in one run, medians over repeats, and counts what a training step of the preset costs. "
        "With device=cuda: training steps, searches and games of two presets, as kernels launched one by one, captured "
        "and compiled, with memory and share of the GPU's arithmetic. An empty device= times the CPU. "
        "Leave the machine idle.",
        ("playslot bench", "playslot bench --json bench.json", "playslot bench device=cuda --json gpu.json"),
        "preset device threads",
    ),
    "models": Command(
        "the models that ship: task, data, steps, time, PSNR, FG-ARI, success, licence",
        "Lists the models that ship, or the one that run= names, with their numbers and how they were made.",
        ("playslot models", "playslot models run=pretrained/block_push", "playslot models --json"),
        "run",
    ),
    "doctor": Command(
        "what works on this machine, and the cure for what does not",
        "Checks Python, torch and device, the GL backend by rendering a frame, PyAV and FFmpeg, disk, cores and cache "
        "folders. Exits with 1 if something essential fails.",
        ("playslot doctor",),
        "device out data.cache",
    ),
}

GROUPS: Final = {
    "dataset": "data sets: info, verify, repair, merge, split, viz, push, pull",
    "cache": "decoded frames and parsed slots on disk: list, clear",
}
"""Commands with actions and options of their own instead of `key=value`."""
