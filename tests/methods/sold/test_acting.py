"""SOLD acting frame by frame: the same as its actor in training, on the whole episode."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.methods.sold.acting import SOLDActor
from playslot_rl.methods.sold.learner import SOLDLearner
from playslot_rl.methods.sold.losses import imagine

Make = Callable[..., SOLDLearner]


def _frames(steps: int) -> torch.Tensor:
    return torch.randint(256, (2, steps, 3, 64, 64), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)


@torch.no_grad()
def _play(acting: SOLDActor, frames: torch.Tensor, **options: object) -> TensorDict:
    memory, seen = acting.initial(len(frames)), []
    for frame in frames.unbind(1):
        out = acting(memory.set(keys.PIXELS, frame))
        seen.append(out.select(keys.SLOTS, keys.ACTION))
        memory = out.exclude(keys.PIXELS, keys.SLOTS)
    return torch.stack(seen, 1)


@torch.no_grad()
def test_at_every_step_of_an_episode_the_actor_says_what_it_says_in_training(make_learner: Make) -> None:
    """In one pass over the episode, and frame by frame in imagination: on the same history the same action."""
    learner = make_learner()
    acting = learner.acting.eval()
    played = _play(acting, _frames(6))
    slots, _ = acting.savi(_frames(6).float() / 255)
    torch.testing.assert_close(played[keys.SLOTS], slots)
    torch.testing.assert_close(played[keys.ACTION], acting.actor(slots)[0])

    class Replayed:
        """Dynamics that say what came."""

        def step(self, given: torch.Tensor, actions: torch.Tensor, past: int | None = None) -> object:
            seen = (past or 0) + given.shape[1]
            return slots[:, seen : seen + 1], seen

    imagined = imagine(Replayed(), acting.actor, slots[:, :2], torch.zeros(2, 1, 4), 4)  # type: ignore[arg-type]
    torch.testing.assert_close(imagined.locations, played[keys.ACTION][:, 1:5])


@torch.no_grad()
def test_an_action_depends_on_all_frames_so_far_and_on_no_later_one(make_learner: Make) -> None:
    acting = make_learner().acting.eval()
    acting.actor.out.weight.mul_(100)
    frames = _frames(6)
    whole = _play(acting, frames)[keys.ACTION]
    for changed in range(6):
        other = frames.clone()
        other[:, changed] = 255 - other[:, changed]
        moved = (_play(acting, other)[keys.ACTION] - whole).abs().amax(dim=(0, 2))
        assert (moved[:changed] == 0).all()
        assert (moved[changed:] > 0).all()


@torch.no_grad()
def test_of_longer_episodes_the_last_frames_are_seen(make_learner: Make) -> None:
    """With one layer keys and values are of single frames: then this is the actor on the last of them alone."""
    learner = make_learner()
    acting = SOLDActor(learner.savi, learner.networks.actor, frames=3, action_dim=4).eval()
    played = _play(acting, _frames(8))
    for t in range(8):
        mean, _, _ = acting.actor(played[keys.SLOTS][:, max(0, t - 2) : t + 1])
        torch.testing.assert_close(played[keys.ACTION][:, t], mean[:, -1])


@torch.no_grad()
def test_episodes_of_different_age_do_not_disturb_each_other(make_learner: Make) -> None:
    acting = make_learner().acting.eval()
    frames = _frames(4)
    alone = _play(acting, frames)
    memory = acting.initial(2)
    for t in range(2):  # the first episode runs ahead by two frames
        out = acting(memory[:1].clone().set(keys.PIXELS, frames[:1, t]))
        memory = torch.cat((out.select(*memory.keys()), memory[1:]))
    out = acting(memory.set(keys.PIXELS, torch.stack((frames[0, 2], frames[1, 0]))))
    torch.testing.assert_close(out[keys.ACTION], torch.stack((alone[keys.ACTION][0, 2], alone[keys.ACTION][1, 0])))


@torch.no_grad()
def test_exploring_draws_from_the_generator_and_evaluation_does_not(make_learner: Make) -> None:
    learner = make_learner()
    memory = learner.initial(2).set(keys.PIXELS, _frames(1)[:, 0])
    drawn = [
        learner.act(memory.clone(), torch.Generator().manual_seed(seed), explore=True)[keys.ACTION]
        for seed in (0, 0, 1)
    ]
    assert torch.equal(drawn[0], drawn[1])
    assert not torch.equal(drawn[0], drawn[2])
    best = [learner.act(memory.clone(), torch.Generator().manual_seed(s), explore=False)[keys.ACTION] for s in (0, 1)]
    assert torch.equal(best[0], best[1])


def test_memory_holds_what_the_loop_and_the_evaluation_hand_on(make_learner: Make) -> None:
    learner = make_learner()
    memory = learner.initial(3)
    assert memory.batch_size == (3,)
    assert torch.equal(memory[keys.ACTION], torch.zeros(3, 4))
    out = learner.act(memory.clone().set(keys.PIXELS, torch.zeros(3, 3, 64, 64, dtype=torch.uint8)), _g(), True)
    assert set(memory.keys()) | set(learner.stored) <= set(out.keys())
    assert torch.equal(learner.acting.reset([5, 6])[keys.SLOT_AGE], torch.zeros(2, 1))


def _g() -> torch.Generator:
    return torch.Generator().manual_seed(0)
