"""What each row of a comparison sees: a line a method, held against what its weights depend on and what it acts on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal
from unittest.mock import patch

import pytest
import torch
from stages import few_videos
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.acting.actor import SlotActor
from playslot_rl.acting.belief import BeliefActor
from playslot_rl.config import plugins
from playslot_rl.config.compose import compose
from playslot_rl.config.methods import METHODS
from playslot_rl.errors import ConfigError
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.recipes import train_baseline, train_dynamics, train_slots
from playslot_rl.runs import Run
from playslot_rl.storage import checkpoints
from playslot_rl.training import record as records

Labels = Literal["none", "some", "all"]
LABELLED = 3


@dataclass(frozen=True)
class Sees:
    """What a row sees.

    Attributes:
        videos: unlabelled ones, of `data.root`.
        labels: real actions: of `behaviour.labelled_demos`, or of all demonstrations that it gets.
        acts_on: what its policy reads of the camera.
        state: its decoder may read that beside the latent action.
        frames: of the camera, at once, at most.
        proprioception: its policy reads it.
    """

    videos: bool
    labels: Labels
    acts_on: Literal["frames", "slots"]
    state: bool = False
    frames: int = 1
    proprioception: bool = False


TABLE = {
    "playslot": Sees(True, "some", "slots", state=True),
    "slot_oracle": Sees(True, "all", "slots"),
    "slot_bc": Sees(True, "all", "slots"),
    "resnet_oracle": Sees(False, "all", "frames"),
    "resnet_bc": Sees(False, "all", "frames"),
    "history_bc": Sees(False, "all", "frames", frames=4),
    "act": Sees(False, "all", "frames"),
    "act_state": Sees(False, "all", "frames", proprioception=True),
    "diffusion": Sees(False, "all", "frames", frames=2),
    "diffusion_state": Sees(False, "all", "frames", frames=2, proprioception=True),
    "autoencoder_bc": Sees(True, "all", "frames"),
    "inverse_bc": Sees(True, "all", "frames"),
    "slot_vpt": Sees(True, "some", "slots"),
    "lapo": Sees(True, "some", "frames", state=True),
    "laom": Sees(True, "some", "frames", state=True),
    "clam": Sees(True, "some", "frames"),
    "lapo_slots": Sees(True, "some", "slots", state=True),
    "caddy_policy": Sees(True, "some", "frames", state=True),
    "caddy_oracle": Sees(True, "all", "frames"),
    "dreamer": Sees(False, "none", "frames"),
    "sold": Sees(True, "none", "slots"),
}
OFFLINE = [name for name in TABLE if not METHODS[name].online]


def test_every_method_that_acts_has_a_line() -> None:
    assert set(TABLE) == {name for name in METHODS if METHODS[name].acts}


@pytest.mark.parametrize("name", TABLE)
def test_videos_are_seen_where_a_model_of_them_is_built_on(name: str) -> None:
    method = METHODS[name]
    assert TABLE[name].videos == (method.slots or method.model is not None)


DECODERS = [name for name in TABLE if METHODS[name].some_labelled and hasattr(METHODS[name].config, "decoder_steps")]


@pytest.mark.parametrize("preset", ["compact", "gpu", "paper"])
@pytest.mark.parametrize("env", ["button_press", "block_push_easy", "block_push", "block_reach", "block_pick"])
def test_policy_and_decoder_see_as_many_samples_as_playslots(env: str, preset: str) -> None:
    config = compose([f"env={env}", f"preset={preset}"])
    own = config.behaviour
    for name in DECODERS:
        rival = getattr(config.baselines, name)
        assert rival.policy.steps * rival.policy.batch_size >= own.steps * own.batch_size, name
        if not hasattr(rival, "decoder_steps"):
            continue  # the decoder learns with the model
        assert rival.decoder_steps * rival.policy.batch_size >= own.decoder_steps * own.batch_size, name


class Trainings:
    """Smoke trainings on eight demonstrations, some of whose actions are others."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.altered = folder, slice(0)
        self.world = folder / "world"

    def open_videos(self, config: Any, *_: str) -> Any:
        found = few_videos(config.env.image_size, config.env.action_dim)
        assert found.actions is not None
        actions = found.actions.copy()
        for start in found.starts[self.altered]:
            actions[start : start + 8] = -0.9 * actions[start : start + 8]
        return replace(found, actions=actions)

    def train(self, name: str, altered: slice = slice(0), *more: str) -> Run:
        """A run of a method; the actions of some demonstrations are others, and so are `more` keys."""
        shared = ["preset=smoke", "env=button_press", "data.root=videos", "device=cpu", "logging.backend=none"]
        shared += [f"data.cache={self.folder / 'cache'}", "behaviour.oracle=false"]
        shared += [f"behaviour.labelled_demos={LABELLED}", "baselines.resnet_oracle.steps=8"]  # a row of each
        self.altered = slice(0)
        if not self.world.is_dir():
            for recipe in (train_slots, train_dynamics):
                recipe.main(compose([*shared, f"out={self.world}"]))
        self.altered, out = altered, self.folder / "-".join((name, str(altered.start), str(altered.stop), *more))
        if not out.is_dir():
            train_baseline.main(compose([*shared, f"method={name}", f"run={self.world}", f"out={out}", *more]))
        return Run(out)


@pytest.fixture(scope="module")
def trainings(tmp_path_factory: pytest.TempPathFactory, thin_resnets: None) -> Iterator[Trainings]:
    made = Trainings(tmp_path_factory.mktemp("sees"))
    with patch.object(records, "open_videos", made.open_videos), patch.object(checkpoints, "provenance", dict):
        yield made


@pytest.mark.integration
@pytest.mark.parametrize("name", OFFLINE)
def test_weights_depend_on_the_actions_that_are_seen_and_on_no_others(name: str, trainings: Trainings) -> None:
    def weights(*altered: int) -> str:
        return trainings.train(name, slice(*altered)).own(METHODS[name].last.name).fingerprint

    labels, plain = TABLE[name].labels, weights(0)
    assert (weights(0, LABELLED) != plain) == (labels != "none")
    assert (weights(LABELLED, 8) != plain) == (labels == "all")


@pytest.mark.integration
@pytest.mark.parametrize("name", TABLE)
def test_it_acts_on_frames_or_on_their_slots(name: str, trainings: Trainings) -> None:
    actor = plugins.call(METHODS[name].load.actor, trainings.train(name), "cpu")
    assert (keys.SLOT_STATE in actor.memory_keys) == (TABLE[name].acts_on == "slots")
    decoders = [part for part in actor.modules() if isinstance(part, ActionDecoder)]
    assert any(decoder.reads_slots for decoder in decoders) == TABLE[name].state


@pytest.mark.integration
@pytest.mark.parametrize("name", TABLE)
def test_it_acts_on_so_many_frames_and_reads_proprioception_where_the_table_says_so(
    name: str, trainings: Trainings
) -> None:
    actor = plugins.call(METHODS[name].load.actor, trainings.train(name), "cpu")
    assert (keys.STATE in actor.in_keys) == TABLE[name].proprioception
    memory = actor.reset([0])
    seen = memory[keys.FRAME_HISTORY].shape[1] if keys.FRAME_HISTORY in actor.memory_keys else 1
    assert seen == TABLE[name].frames


@pytest.mark.integration
@pytest.mark.parametrize("name", [name for name in OFFLINE if TABLE[name].acts_on == "slots"])
def test_it_acts_on_the_slots_that_its_policy_is_to_see(name: str, trainings: Trainings) -> None:
    actor = plugins.call(METHODS[name].load.actor, trainings.train(name, slice(0), "model.policy.slots=[3,1]"), "cpu")
    assert isinstance(actor, SlotActor)
    for decoder in actor.modules():
        if isinstance(decoder, ActionDecoder) and decoder.reads_slots:
            decoder.trusts_slots.fill_(True)
    seen = torch.randn(1, *actor.reset([0])[keys.SLOT_STATE].shape[1:])
    acted = actor.heads(TensorDict({keys.SLOTS: seen}, [1]))[keys.ACTION]
    changed = []
    for n in range(seen.shape[1]):
        other = seen.clone()
        other[:, n] = torch.randn(seen.shape[2])
        changed.append(not torch.equal(actor.heads(TensorDict({keys.SLOTS: other}, [1]))[keys.ACTION], acted))
    assert changed == [n in (0, 2) for n in range(seen.shape[1])]


@pytest.mark.integration
def test_a_policy_of_frames_is_not_told_of_slots(trainings: Trainings) -> None:
    run = trainings.train("resnet_bc", slice(0), "model.policy.slots=[3,1]")
    plain = trainings.train("resnet_bc")
    of = METHODS["resnet_bc"].last.name
    weights = (trained.folder / of / "checkpoint" / "weights.safetensors" for trained in (run, plain))
    assert len({path.read_bytes() for path in weights}) == 1


@pytest.mark.integration
@pytest.mark.parametrize("name", [name for name in OFFLINE if TABLE[name].acts_on == "slots"])
def test_slots_that_there_are_not_are_refused(name: str, trainings: Trainings) -> None:
    with pytest.raises(ConfigError, match=r"model\.policy\.slots: got 9, expected at most the \d slots of SAVi"):
        trainings.train(name, slice(0), "model.policy.slots=[9]")


@pytest.mark.integration
def test_a_gain_changes_how_playslot_acts_and_no_weights(trainings: Trainings) -> None:
    run, plain = trainings.train("playslot", slice(0), "behaviour.gain=0.25"), trainings.train("playslot")
    actor = plugins.call(METHODS["playslot"].load.actor, run, "cpu")
    assert isinstance(actor, BeliefActor)
    assert actor.policy.gain == 0.25
    weights = (trained.folder / "policy" / "checkpoint" / "weights.safetensors" for trained in (run, plain))
    assert len({path.read_bytes() for path in weights}) == 1
