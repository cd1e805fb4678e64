"""Imagined rows end at the trained horizon; slots are trusted where they pay; fine-tuning keeps cloning."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from playslot_rl.config import ActionDecoderConfig, BehaviourStageConfig, OptimConfig, PolicyConfig
from playslot_rl.data.demonstrations import Demonstrations
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.training.stage import step_loss
from playslot_rl.training.stage_behaviour import CloneStage, DecoderStage, FinetuneStage, SeenSlots, cloning_settings
from playslot_rl.training.stage_regression import TensorInputs

STEPS, DEMOS, Z, D, A = 30, 8, 5, 6, 3
CONFIG = BehaviourStageConfig(batch_size=32, labelled_demos=6, oracle=False, decoder_state=True)


def demonstrations(actions: str = "slots", seed: int = 0) -> Demonstrations:
    """Eight episodes of random slots and latents; actions follow from one of the two.

    `spurious`: from the latents, and in the first three episodes only the slots say them, too.
    """
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> Tensor:
        return torch.randn(DEMOS * STEPS, *shape, generator=generator)

    slots, latents = draw(3, D), draw(Z)
    read = slots.mean(1)[:, :A] * 2 if actions == "slots" else latents[:, :A]
    if actions == "spurious":
        slots[: 3 * STEPS, :, :A] = 3 * read[: 3 * STEPS, None]
    return Demonstrations(
        slots=slots, imagined=draw(3, D), latents=latents, actions=read.tanh(),
        episode=torch.arange(DEMOS).repeat_interleave(STEPS), step=torch.arange(STEPS).repeat(DEMOS),
        lengths=torch.full((DEMOS,), STEPS),
    )  # fmt: skip


def networks() -> tuple[LatentPolicy, ActionDecoder]:
    torch.manual_seed(0)
    sizes = ActionDecoderConfig(32, state_dim=16, state_layers=1, state_heads=2, whiten=True, reads_slots=True)
    policy = LatentPolicy(PolicyConfig(dim=16, layers=1, heads=2, head_dim=8, mlp_dim=16), D, Z, whiten=True)
    return policy, ActionDecoder(sizes, Z, A, D)


def train(stage: DecoderStage | FinetuneStage, steps: int, lr: float = 3e-3) -> None:
    parameters = [p for module in stage.modules.values() for p in module.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=lr)
    for step in range(steps):
        optimiser.zero_grad()
        step_loss(stage, step, StepGenerators(0, step))["loss"].backward()
        optimiser.step()


def test_a_policy_needs_slots_to_clone_from() -> None:
    with pytest.raises(ValueError, match=r"behaviour\.parsed: got False, expected true, or behaviour\.imagined=true"):
        replace(CONFIG, parsed=False, imagined=False)


def test_imagined_rows_end_at_the_horizon() -> None:
    demos = demonstrations()
    seen = SeenSlots.of(demos, CONFIG, horizon=2)
    far = demos.step <= 2
    inputs, whole = TensorInputs(seen.slots), torch.cat(seen.slots)
    assert torch.equal(whole, torch.cat((demos.slots, demos.imagined[far])))
    some = torch.randperm(len(inputs), generator=torch.Generator().manual_seed(0))[:50]
    assert torch.equal(inputs.plain(some), whole[some])
    assert SeenSlots.of(demos, CONFIG, horizon=None).slots[1] is demos.imagined, "nothing is copied where all are seen"
    assert torch.equal(seen.rows, torch.cat((torch.arange(len(far)), torch.nonzero(far)[:, 0])))
    assert len(SeenSlots.of(demos, CONFIG, horizon=None).rows) == 2 * len(far)
    assert torch.equal(SeenSlots.of(demos, replace(CONFIG, imagined=False), horizon=2).slots[0], demos.slots)
    alone = SeenSlots.of(demos, replace(CONFIG, parsed=False), horizon=2)
    assert torch.equal(alone.slots[0], demos.imagined[far])
    assert torch.equal(demos.latents[alone.rows], demos.latents[far])


@pytest.mark.integration
@pytest.mark.parametrize(("source", "pays"), [("slots", True), ("spurious", False)])
def test_slots_are_trusted_where_they_pay(source: str, pays: bool) -> None:
    policy, decoder = networks()
    decoder.trusts_slots.fill_(False)  # as the recipe leaves it until the trial has told
    demos = demonstrations(source)
    trial = DecoderStage.trial(decoder, policy, demos, replace(CONFIG, decoder_inputs="inverse_dynamics"))
    half = torch.nonzero(demos.episode < 3)[:, 0]
    assert demos.actions is not None
    assert torch.equal(trial.targets, demos.actions[half]), "the first half of the labelled ones, no other"
    held = trial.checks["unexplained_held_out"][1]
    assert torch.equal(held, demos.actions[(demos.episode >= 3) & (demos.episode < 6)])
    train(trial, 250)
    assert trial.slots_pay() is pays


@pytest.mark.parametrize("labels_of_all", [True, False])
def test_slots_are_tried_on_other_tasks_where_some_have_no_label(labels_of_all: bool) -> None:
    """The six labelled demonstrations are of tasks 0 and 1 by turns, the others of 1, or of 2."""
    policy, decoder = networks()
    demos = demonstrations("slots")
    task = torch.where(demos.episode < 6, demos.episode % 2, torch.full_like(demos.episode, 2 - labels_of_all))
    told = replace(demos, task=task[:, None])
    trial = DecoderStage.trial(decoder, policy, told, replace(CONFIG, decoder_inputs="inverse_dynamics"))
    assert trial is not None
    assert demos.actions is not None
    labelled = demos.episode < 6
    second = demos.episode >= 3 if labels_of_all else task == 1
    assert torch.equal(trial.targets, demos.actions[labelled & ~second])
    assert torch.equal(trial.checks["unexplained_held_out"][1], demos.actions[labelled & second])
    alone = replace(told, task=torch.where(labelled, 0, 2)[:, None])
    assert DecoderStage.trial(decoder, policy, alone, CONFIG) is None, "one task cannot tell"


def test_a_decoder_that_does_not_trust_slots_acts_without_them() -> None:
    _, decoder = networks()
    decoder.eval()
    z, slots = torch.randn(4, Z), torch.randn(4, 3, D)
    blind = decoder(z)
    assert not torch.equal(decoder(z, slots), blind)
    decoder.trusts_slots.fill_(False)
    assert torch.equal(decoder(z, slots), blind)
    again = networks()[1]
    again.load_state_dict(decoder.state_dict())
    assert not bool(again.trusts_slots), "it is stored"


@pytest.mark.integration
def test_fine_tuning_learns_actions_and_goes_on_cloning() -> None:
    policy, decoder = networks()
    demos, config = demonstrations("slots"), replace(CONFIG, imagined=False)
    clone = CloneStage(policy, None, demos, cloning_settings(config))
    stage = FinetuneStage(clone.stages["policy"], decoder, demos, config, demonstrations("slots", seed=1))
    assert set(stage.modules) == {"policy", "action_decoder"}
    losses = step_loss(stage, 0, StepGenerators(0, 0))
    assert float((losses["action"] + losses["latent"]).detach()) == pytest.approx(float(losses["loss"].detach()))
    before = stage.validate(0)["unexplained_held_out"]
    train(stage, 150)
    after = stage.validate(0)
    assert after["unexplained_held_out"] < 0.85 * before
    assert after["unexplained"] < after["unexplained_held_out"]


def test_slots_that_are_not_trusted_are_not_tuned_on() -> None:
    policy, decoder = networks()
    decoder.trusts_slots.fill_(False)
    demos, config = demonstrations("slots"), replace(CONFIG, imagined=False)
    clone = CloneStage(policy, None, demos, cloning_settings(config))
    before = deepcopy(decoder.state_dict())
    train(FinetuneStage(clone.stages["policy"], decoder, demos, config), 3)
    changed = {name.partition(".")[0] for name, value in decoder.state_dict().items() if not value.equal(before[name])}
    assert changed == {"layers"}


def test_what_decides_the_policy_says_nothing_of_labels_and_decoder() -> None:
    other = replace(
        CONFIG,
        labelled_demos=3,
        decoder_state=False,
        decoder_steps=7,
        finetune_steps=9,
        finetune_labels=2,
        policy_from="elsewhere",
    )
    assert cloning_settings(other) == cloning_settings(CONFIG)
    for change in ({"trim": 0.5}, {"whiten": True}, {"steps": 3}, {"optim": OptimConfig(lr=1.0)}, {"imagined": False}):
        assert cloning_settings(replace(CONFIG, **change)) != cloning_settings(CONFIG)


def test_a_trial_leaves_the_decoder_it_copies_alone() -> None:
    policy, decoder = networks()
    before = deepcopy(decoder.state_dict())
    trial = DecoderStage.trial(decoder, policy, demonstrations(), CONFIG)
    assert trial is not None
    train(trial, 3)
    assert all(torch.equal(value, before[name]) for name, value in decoder.state_dict().items())
