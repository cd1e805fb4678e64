"""SOLD acting frame by frame: the same as its actor on the whole past."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict

from playslot_rl import keys
from playslot_rl.methods.sold.learner import SOLDLearner
from playslot_rl.methods.sold.networks import SOLDActor

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


def test_frame_by_frame_equals_the_whole_clip_seen_through_its_window(make_learner: Make) -> None:
    acting = make_learner().acting.eval()
    frames = _frames(5)
    played = _play(acting, frames)
    with torch.no_grad():
        slots, _ = acting.savi(frames.float() / 255)
        windows = [slots[:, max(0, t + 1 - acting.window) : t + 1] for t in range(5)]
        location = torch.stack([acting.actor(window)[0][:, -1] for window in windows], dim=1)
    torch.testing.assert_close(played[keys.SLOTS], slots)
    torch.testing.assert_close(played[keys.ACTION], location)


def test_past_the_window_the_actor_sees_its_last_frames(make_learner: Make) -> None:
    learner = make_learner()
    acting = SOLDActor(learner.savi, learner.networks.actor, window=3, action_dim=4).eval()
    played = _play(acting, _frames(5))
    with torch.no_grad():
        location, _, _ = acting.actor(played[keys.SLOTS][:, 2:5])
    torch.testing.assert_close(played[keys.ACTION][:, 4], location[:, 2])


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
