"""LeRobot's policies are LeRobot's: the same rows, losses, updates and actions as its own programs have."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.utils.data import default_collate
from torchvision.models import resnet18

from playslot_rl import keys
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compose import choices, compose
from playslot_rl.data.demonstrations import real_actions, transitions
from playslot_rl.data.source import open_sources
from playslot_rl.errors import ConfigError, DataError
from playslot_rl.methods.lerobot_policy import method
from playslot_rl.methods.lerobot_policy.actor import ChunkActor
from playslot_rl.methods.lerobot_policy.method import ACTConfig, ChunkConfig, DiffusionConfig
from playslot_rl.methods.lerobot_policy.policy import PAD, ChunkPolicy, Observation, chunk_policy
from playslot_rl.methods.lerobot_policy.training import Chunks, _optimizer, chunked
from playslot_rl.methods.resnet_oracle.network import load_trunk
from playslot_rl.seeds.draws import derived_seed
from playslot_rl.storage.tensors import load_modules, module_tensors, save_tensors

NAMES = ("act", "diffusion")
LENGTHS = (9, 6)
"""Rows of two episodes, the last of which has no action."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set as ours are, written by LeRobot."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root, numbers = tmp_path_factory.mktemp("set") / "demos", np.random.default_rng(0)
    features = {
        keys.FEATURE_IMAGE: {"dtype": "image", "shape": (64, 64, 3), "names": ["height", "width", "channels"]},
        keys.FEATURE_STATE: {"dtype": "float32", "shape": (4,), "names": None},
        keys.FEATURE_ACTION: {"dtype": "float32", "shape": (4,), "names": None},
    }
    dataset = LeRobotDataset.create(
        "me/demos", fps=10, features=features, root=root, use_videos=False, robot_type="button_press"
    )
    for rows in LENGTHS:
        for step in range(rows):
            dataset.add_frame(
                {
                    keys.FEATURE_IMAGE: numbers.integers(0, 256, (64, 64, 3), np.uint8),
                    keys.FEATURE_STATE: numbers.normal(size=4).astype(np.float32),
                    keys.FEATURE_ACTION: numbers.uniform(-1, 1, 4).astype(np.float32) * np.float32(step < rows - 1),
                    "task": "push",
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return root


def made(name: str, *more: str, state: int = 0) -> tuple[ExperimentConfig, Any, ChunkPolicy]:
    """Config, settings and an untrained policy of the smoke preset, that sees `state` numbers of proprioception."""
    config = compose(["preset=smoke", "env=button_press", *more])
    own = getattr(config.baselines, name)
    torch.manual_seed(0)
    policy = chunk_policy(own, config.env, own.sized(8), state)
    policy.give(torch.rand(20, 4) * 2 - 1, torch.rand(20, state) if state else None)
    return config, own, policy


def theirs(name: str, policy: ChunkPolicy, recorded: Path) -> tuple[Any, Any]:
    """LeRobot's data set with the windows that its policy asks for, and its processors with its statistics."""
    from lerobot.datasets.compute_stats import get_feature_stats
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
    from lerobot.datasets.factory import IMAGENET_STATS, resolve_delta_timestamps
    from lerobot.datasets.lerobot_dataset import LeRobotDataset
    from lerobot.policies.factory import make_pre_post_processors

    source = open_sources(recorded, cache=recorded.parent / "cache")
    rows = transitions(source).rows
    actions, states = real_actions(source, rows, 4), torch.from_numpy(source.require_states()[rows])
    policy.give(actions, states if policy.state_dim else None)
    meta = LeRobotDatasetMetadata("me/demos", root=recorded)
    deltas = resolve_delta_timestamps(policy.policy.config, meta)
    stats = {
        keys.FEATURE_IMAGE: {key: torch.tensor(value) for key, value in IMAGENET_STATS.items()},
        keys.FEATURE_ACTION: get_feature_stats(actions.numpy(), axis=0, keepdims=False),
        keys.FEATURE_STATE: get_feature_stats(states.numpy(), axis=0, keepdims=False),
    }
    processors = make_pre_post_processors(policy.policy.config, dataset_stats=stats)
    return LeRobotDataset("me/demos", root=recorded, delta_timestamps=deltas, video_backend="pyav"), processors


def ours(config: ExperimentConfig, own: ChunkConfig, policy: ChunkPolicy, recorded: Path) -> tuple[Chunks, list[int]]:
    """Our rows, and their numbers in the data set."""
    source = open_sources(recorded, cache=recorded.parent / "cache")
    found = chunked(config, source, own, policy.chunk, torch.device("cpu"), 0, bool(policy.state_dim))
    return found, [int(row) for row in found.frames.rows[:, -1]]


@pytest.mark.integration
@pytest.mark.parametrize("state", [0, 4])
@pytest.mark.parametrize("name", NAMES)
def test_rows_and_losses_are_those_of_lerobots_reader_and_processors(name: str, state: int, recorded: Path) -> None:
    config, own, policy = made(name, state=state)
    dataset, (before, _) = theirs(name, policy, recorded)
    found, numbers = ours(config, own, policy, recorded)
    last = np.cumsum(LENGTHS) - 1
    assert not set(numbers) & {*last.tolist()}
    items, begin = [], 1 - own.frames
    for row, number in enumerate(numbers):
        item = dataset[number]
        empty = torch.tensor([number + begin + k in last for k in range(policy.chunk)])
        torch.testing.assert_close(found.pad[row], item[PAD] | empty)
        real = ~found.pad[row]
        torch.testing.assert_close(found.actions[row][real], item[keys.FEATURE_ACTION][real])
        seen = item[keys.FEATURE_IMAGE].reshape(own.frames, 3, 64, 64)
        torch.testing.assert_close(found.frames.plain(torch.tensor([row]))[0] / 255, seen)
        if found.states is not None:
            torch.testing.assert_close(found.states[row], item[keys.FEATURE_STATE].reshape(own.frames, 4))
        # ACT's loss leaves padding out, whatever stands there; the other's learns it.
        same = name == "act" or not empty.any()
        items += [(row, {**item, PAD: found.pad[row]})] if same else []
    whole = [row for row, _ in items]
    assert found.pad[whole].any()
    batch: dict[str, Any] = before(default_collate([item for _, item in items]))
    if not state:
        batch[keys.FEATURE_STATE] = torch.zeros(len(whole), own.frames, 1)
    torch.manual_seed(3)
    expected = policy.policy.forward(batch)[0]
    torch.manual_seed(3)
    rows = torch.tensor(whole)
    states = None if found.states is None else found.states[rows]
    got = policy.loss(Observation(found.frames.plain(rows), states), found.actions[rows], found.pad[rows])
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-6)


def test_padding_repeats_a_real_action_and_never_the_empty_one(recorded: Path) -> None:
    config, own, policy = made("act")
    found, _ = ours(config, own, policy, recorded)
    assert (found.actions.abs().sum(-1) > 0).all()
    assert found.pad.any()
    assert not found.pad[:, 0].any()


def test_a_set_without_proprioception_is_refused_in_one_line(recorded: Path) -> None:
    config, own, policy = made("act", state=4)
    source = replace(open_sources(recorded, cache=recorded.parent / "cache"), states=None)
    with pytest.raises(DataError, match=r"got a data set without proprioception, expected .* `observation.state`:"):
        chunked(config, source, own, policy.chunk, torch.device("cpu"), state=True)


def played(policy: ChunkPolicy, frames: Tensor, states: Tensor, before: Any, after: Any, noise: Any) -> Tensor:
    """Actions (T, n, A) by LeRobot's own queues."""
    chosen = []
    policy.policy.reset()
    for step, (pixels, state) in enumerate(zip(frames, states, strict=True)):
        batch = before({keys.FEATURE_IMAGE: pixels / 255, keys.FEATURE_STATE: state})
        chosen.append(after(policy.policy.select_action(batch, **noise(step))))
    return torch.stack(chosen)


@pytest.mark.parametrize("state", [0, 3])
@pytest.mark.parametrize("name", NAMES)
def test_it_acts_as_lerobots_select_action(name: str, state: int) -> None:
    _, own, policy = made(name, "baselines.diffusion.scheduler=DDIM", state=state)
    policy.eval()
    frames = torch.randint(256, (5, 2, 3, 64, 64), dtype=torch.uint8)
    states = torch.rand(5, 2, state) if state else torch.zeros(5, 2, 1)
    seeds = (3, 4)

    def noise(step: int) -> dict[str, Tensor]:
        if name == "act":
            return {}
        drawn = [torch.Generator().manual_seed(derived_seed(seed, step, "noise")) for seed in seeds]
        return {"noise": torch.stack([torch.randn(policy.chunk, 4, generator=one) for one in drawn])}

    expected = played(policy, frames, states, *policy.processors(), noise)
    loop = ClosedLoop(ChunkActor(policy, 64))
    loop.reset(seeds)
    seen = [TensorDict({keys.PIXELS: p, keys.STATE: s}, [2]) for p, s in zip(frames, states, strict=True)]
    got = torch.stack([loop.step(observation)[keys.ACTION].clamp(-1, 1) for observation in seen])
    torch.testing.assert_close(got, expected.clamp(-1, 1), rtol=1e-4, atol=1e-5)
    assert own.executed == 2
    assert not torch.equal(expected[0], expected[1])


@pytest.mark.parametrize("name", NAMES)
def test_a_step_is_one_of_lerobots_optimiser(name: str) -> None:
    _, own, policy = made(name)
    preset = policy.policy.config.get_optimizer_preset()
    assert own.weight_decay == preset.weight_decay
    ends = []
    for build in (
        lambda parameters: _optimizer(policy, own, parameters, replace(own.optim, lr=preset.lr)),
        lambda parameters: preset.build(list(parameters.values())),
    ):
        torch.manual_seed(1)
        weight = torch.nn.Parameter(torch.randn(5))
        optimizer = build({"w": weight})
        for _ in range(3):
            weight.grad = torch.randn(5)
            optimizer.step()
        ends.append(weight.detach())
    torch.testing.assert_close(ends[0], ends[1])


@pytest.mark.parametrize("name", NAMES)
def test_a_pretrained_resnet_is_found_by_torchvisions_names(name: str, tmp_path: Path) -> None:
    _, _, policy = made(name)
    published = resnet18(weights=None)
    save_tensors(tmp_path / "resnet.safetensors", published.state_dict())
    trunk, names = policy.trunk()
    assert load_trunk(trunk, str(tmp_path / "resnet.safetensors"), "weights", names) == "imagenet"
    pixels = torch.rand(2, 3, 64, 64)
    whole = published.eval()
    seen: dict[str, Tensor] = {}
    whole.layer4.register_forward_hook(lambda _, __, out: seen.update(out=out))
    whole(pixels)
    found: Any = trunk.eval()(pixels)
    found = found["feature_map"] if isinstance(found, Mapping) else found
    torch.testing.assert_close(found, seen["out"], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_a_resnet_from_scratch_learns_its_norms_and_then_acts_as_with_frozen_ones(name: str) -> None:
    _, _, frozen = made(name)
    _, _, policy = made(name)
    policy.learn_norms()
    trunk, _ = policy.trunk()
    norms = [part for part in trunk.modules() if "Norm" in type(part).__name__]
    assert len(norms) == 20
    assert all(norm.weight.requires_grad for norm in norms)
    pixels = 0.3 + torch.rand(4, 3, 64, 64)
    trunk.train()(pixels)
    assert any(float(norm.running_mean.abs().max()) > 1e-3 for norm in norms)
    load_modules({"policy": frozen}, module_tensors({"policy": policy}), "")
    outs: list[Any] = [part.trunk()[0].eval()(pixels) for part in (frozen, policy)]
    got, wanted = (out["feature_map"] if isinstance(out, Mapping) else out for out in outs)
    torch.testing.assert_close(got, wanted, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("own", "longest", "chunk", "executed"),
    [
        (ACTConfig(), 25, 20, 20),
        (ACTConfig(chunk=10, executed=4), 25, 10, 4),
        (ACTConfig(executed=12), 7, 7, 7),
        (DiffusionConfig(), 25, 16, 8),
        (DiffusionConfig(), 20, 16, 8),
        (DiffusionConfig(), 13, 8, 7),
        (DiffusionConfig(executed=0), 3, 8, 7),
    ],
)
def test_a_chunk_is_no_longer_than_the_demonstrations(
    own: ChunkConfig, longest: int, chunk: int, executed: int
) -> None:
    assert (own.sized(longest), own.kept(chunk)) == (chunk, executed)


@pytest.mark.parametrize("preset", choices("preset"))
@pytest.mark.parametrize("env", choices("env"))
def test_every_task_and_preset_has_sizes_that_fit(env: str, preset: str) -> None:
    config = compose([f"env={env}", f"preset={preset}"])
    for name in NAMES:
        own = getattr(config.baselines, name)
        with torch.device("meta"):
            policy = chunk_policy(own, config.env, own.sized(config.env.max_steps))
        assert 1 <= policy.executed <= policy.chunk <= 20


def test_without_diffusers_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(method, "find_spec", lambda _: None)
    config = compose(["preset=smoke"])
    with pytest.raises(ConfigError, match=r"got no package diffusers, expected it: pip install 'playslot_rl\[diff"):
        config.baselines.diffusion.check("baselines.diffusion", config)
