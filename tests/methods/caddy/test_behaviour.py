"""CADDY's heads: what they read, what they clone, whose labels are decoded, what stays frozen."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from caddy_parts import tiny
from clips import moving_square
from torch.nn import functional as F

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.compose import compose
from playslot_rl.data.demonstrations import DemonstrationSplit, transitions
from playslot_rl.data.neighbours import pairs_at
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import DIRECTIONS
from playslot_rl.methods.caddy.behaviour import CADDYBehaviour, MovesLoss, infer_moves, oracle_stage
from playslot_rl.methods.caddy.heads import MovesHead, OnFrames, as_moves, states_of
from playslot_rl.methods.caddy.model import CADDY
from playslot_rl.methods.cloning import inferred
from playslot_rl.modules.action_decoder import ActionDecoder
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.storage.checkpoints import StageCheckpoint, save_stage
from playslot_rl.training.stage import step_loss
from playslot_rl.training.stage_regression import RegressionStage

pytestmark = pytest.mark.integration

SIZE, CPU = 32, torch.device("cpu")


@pytest.fixture
def config() -> ExperimentConfig:
    whole = compose(["preset=smoke", "behaviour.labelled_demos=1", f"env.image_size={SIZE}"])
    return replace(whole, env=replace(whole.env, action_dim=2))


@pytest.fixture
def caddy() -> CADDY:
    return tiny(SIZE).eval()


@pytest.fixture
def finished(caddy: CADDY, config: ExperimentConfig, tmp_path: Path) -> StageCheckpoint:
    return save_stage(
        tmp_path / "caddy",
        stage="caddy",
        modules={"caddy": caddy},
        config={"env": to_dict(config.env), "caddy": to_dict(caddy.config)},
        data={},
        parents={},
        metrics={},
        steps=1,
        seconds=0.0,
    )


def split(source: EpisodeFrames) -> DemonstrationSplit:
    return DemonstrationSplit(source, source, moving_square(episodes=2, seed=1))


def behaviour(config: ExperimentConfig, finished: StageCheckpoint, source: EpisodeFrames) -> CADDYBehaviour:
    return CADDYBehaviour(config, finished, split(source), CPU)


def decoder_stage(made: CADDYBehaviour, clone: RegressionStage) -> RegressionStage:
    def part(name: str, stage: object, *_: float) -> object:
        return name, stage

    found = dict(made.decoding(clone, part, 4, 1e-3))  # type: ignore[arg-type]
    assert set(found) == {"decoder", "finetune"}, "one demonstration cannot tell whether the state pays"
    assert not made.decoder.acts_on_slots
    return found["decoder"]  # type: ignore[index]


def changed(source: EpisodeFrames, frame: int) -> EpisodeFrames:
    frames = source.frames.copy()  # type: ignore[union-attr]
    frames[frame] = 255 - frames[frame]
    return replace(source, frames=frames)


def test_the_policy_clones_what_the_frozen_model_infers(
    config: ExperimentConfig, finished: StageCheckpoint, caddy: CADDY
) -> None:
    source = moving_square()
    stage = behaviour(config, finished, source).policy_stage()
    rows = transitions(source).rows
    pairs = source.pixels(np.stack((rows, rows + 1), axis=1))
    latents = caddy.infer(pairs)
    torch.testing.assert_close(stage.targets, torch.cat((latents.a, latents.v), dim=-1)[:, 0], atol=1e-5, rtol=1e-4)
    assert set(stage.targets[:, :3].unique().tolist()) == {0.0, 1.0}
    assert stage.targets[:, :3].sum(dim=1).eq(1).all()
    assert not stage.targets.requires_grad


@pytest.mark.parametrize("oracle", [False, True])
def test_training_leaves_the_encoder_and_its_statistics_as_they_are(
    config: ExperimentConfig, finished: StageCheckpoint, monkeypatch: pytest.MonkeyPatch, oracle: bool
) -> None:
    read: list[CADDY] = []

    def kept(done: StageCheckpoint, device: object) -> CADDY:
        from playslot_rl.methods.caddy.heads import load_model

        read.append(load_model(done))
        return read[0]

    monkeypatch.setattr("playslot_rl.methods.caddy.behaviour.load_model", kept)
    demos = split(moving_square())
    stage = (
        oracle_stage(config, finished, demos, CPU)
        if oracle
        else CADDYBehaviour(config, finished, demos, CPU).policy_stage()
    )
    (model,) = read
    before = {name: value.clone() for name, value in model.state_dict().items()}
    (head,) = stage.modules.values()
    head.train()
    optimizer = torch.optim.Adam(head.parameters(), lr=1e-2)
    for step in range(3):
        optimizer.zero_grad()
        step_loss(stage, step, StepGenerators(0, step))["loss"].backward()
        assert all(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in head.parameters())
        optimizer.step()
    assert all(p.grad is None for p in model.parameters())
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())


def test_the_policy_reads_the_current_frame_only(config: ExperimentConfig, finished: StageCheckpoint) -> None:
    source, rows = moving_square(), torch.tensor([1])
    plain = behaviour(config, finished, source)
    for frame, reads in ((0, False), (1, True), (2, False)):
        other = behaviour(config, finished, changed(source, frame))
        same = torch.equal(other.trained.inputs.plain(rows), plain.trained.inputs.plain(rows))  # type: ignore[arg-type]
        assert same != reads, f"frame {frame} of the transition from frame 1"
    later = behaviour(config, finished, changed(source, 2))
    assert not torch.equal(later.trained.latents[1], plain.trained.latents[1]), "the model sees what comes after"


@pytest.mark.parametrize("inputs", ["inverse_dynamics", "policy", "both"])
def test_the_decoder_reads_the_labels_it_may_and_no_others(
    config: ExperimentConfig, finished: StageCheckpoint, inputs: str
) -> None:
    source = moving_square()
    assert source.actions is not None
    hidden = source.actions.copy()
    hidden[int(source.lengths[0]) :] = np.nan
    config = replace(config, behaviour=replace(config.behaviour, decoder_inputs=inputs))  # type: ignore[arg-type]
    made = [behaviour(config, finished, replace(source, actions=given)) for given in (source.actions, hidden)]
    policies = [one.policy_stage() for one in made]
    stages = [decoder_stage(one, clone) for one, clone in zip(made, policies, strict=True)]
    times = (2 if inputs == "both" else 1) * (1 + len(DIRECTIONS))  # shifted frames, too
    assert [len(stage.targets) for stage in stages] == [times * (int(source.lengths[0]) - 1)] * 2
    assert torch.equal(stages[0].targets, stages[1].targets)
    assert torch.isfinite(stages[1].targets).all()
    assert torch.equal(policies[0].targets, policies[1].targets), "the policy reads no action at all"


def test_the_loss_is_cross_entropy_and_squared_error_in_units_of_the_variance() -> None:
    torch.manual_seed(0)
    head, states = MovesHead(8, actions=3, latent_dim=2).eval(), torch.randn(5, 8, 4, 4)
    v = 0.01 * torch.randn(50, 2) + 3
    head.standardise(v)
    moves = torch.cat((F.one_hot(torch.tensor([0, 1, 2, 1, 1]), 3).float(), v[:5]), dim=1)
    with torch.no_grad():
        out = head(states)
        got = MovesLoss(head)({keys.STATE_MAPS: states, keys.LATENT_ACTION: moves})["loss_policy"]  # type: ignore[arg-type]
    log_p = out[:, :3].log_softmax(dim=1)
    variance = (v - v.mean(dim=0)).square().mean()
    expected = -(moves[:, :3] * log_p).sum(dim=1).mean() + (out[:, 3:] - v[:5]).square().mean() / variance
    torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-5)
    assert float((out[:, 3:] - 3).abs().max()) < 0.1, "an untrained head starts near the mean, in the scale of v"


def test_it_acts_by_the_most_probable_action_and_the_variability() -> None:
    caddy = tiny(SIZE).eval()
    head, decoder = MovesHead(8, 3, 2).eval(), ActionDecoder(compose(["preset=smoke"]).model.action_decoder, 5, 4)
    pixels = torch.randint(256, (4, 3, SIZE, SIZE), dtype=torch.uint8)
    moves = OnFrames(caddy.encoder, head)(pixels)
    out = head(states_of(caddy.encoder, pixels))
    assert torch.equal(moves, as_moves(out, 3))
    assert torch.equal(moves[:, :3].argmax(dim=1), out[:, :3].argmax(dim=1))
    assert torch.equal(moves[:, 3:], out[:, 3:])
    assert decoder(moves).shape == (4, 4)


def test_validation_counts_mistaken_actions_and_unexplained_variability_on_held_out_demonstrations_too(
    config: ExperimentConfig, finished: StageCheckpoint
) -> None:
    made = behaviour(config, finished, moving_square())
    made.policy.eval()
    with torch.no_grad():
        numbers = made.policy_stage().validate(0)
        out = made.policy(made.trained.inputs.plain(torch.arange(len(made.trained.latents))))
    assert numbers.keys() == {f"{name}{end}" for name in ("unexplained", "mistaken") for end in ("", "_held_out")}
    wrong = out[:, :3].argmax(dim=1) != made.trained.latents[:, :3].argmax(dim=1)
    assert numbers["mistaken"] == pytest.approx(float(wrong.float().mean()))


def test_moves_of_transitions_are_in_the_order_of_their_rows(caddy: CADDY) -> None:
    source = moving_square()
    moves = transitions(source)
    found = inferred(partial(infer_moves, caddy), source.pixels, pairs_at(moves.rows))
    assert found.shape == (len(moves.rows), 5)
    latents = caddy.infer(source.pixels(np.array([[moves.rows[7], moves.rows[7] + 1]])))
    torch.testing.assert_close(found[7], torch.cat((latents.a, latents.v), dim=-1)[0, 0], atol=1e-5, rtol=1e-4)
