"""One player's session: steps, touches, time travel; no browser is needed.

Shapes: N slots of the world model, n of them still there, K prototypes, P imagined frames, D slot width,
Z latent-action width, A action width, H W image height and width. "[N,]" is there with one latent action per slot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.imagination import ImaginationSession
from playslot_rl.frames import to_uint8
from playslot_rl.modules.savi.health import owners
from playslot_rl.play.starts import Start
from playslot_rl.play.steering import Driver, PlannerDriver, policy_drivers, require_prototypes, variability_directions
from playslot_rl.play.timeline import Frame, SceneMoment, Timeline
from playslot_rl.runtime.captured import Captured
from playslot_rl.world_model import Agent, WorldModel

PREVIEW: Final = 6
"""Frames of a prototype's small animation."""


@dataclass(frozen=True)
class Look:
    """The present moment, drawn: its frame uint8 (H, W, 3), the number of the slot that each pixel belongs to, int64
    (H, W), and what each slot draws, its colours weighted by its mask on white, uint8 (n, H, W, 3).
    """

    frame: Frame
    owner: npt.NDArray[np.int64]
    objects: Frame


class PlaySession:
    """An imagined future under a user's hand; not for several threads at once: a page hands every call to one worker.

    The agent, of the world model, is for the policy and the decoded actions; `directions` (K, Z) are those of
    `variability_directions`, None takes the codebook's. `drivers` may take over, by name. A CheckpointError where the
    world model has no prototypes.
    """

    start: Start
    timeline: Timeline

    def __init__(self, world_model: WorldModel, agent: Agent | None = None, directions: Tensor | None = None) -> None:
        self.world_model, self.agent = world_model.eval(), agent
        self.prototypes = require_prototypes(world_model)
        self.directions = variability_directions(world_model, None) if directions is None else directions
        self.drivers: dict[str, Driver] = {}
        self.planner: PlannerDriver | None = None
        if agent is not None:
            self.planner = PlannerDriver(agent)
            self.drivers = {**policy_drivers(agent, self.planner), "planner": self.planner}
        self._imagination = ImaginationSession(world_model)
        self._decode = Captured(world_model.savi.decode, world_model.savi)
        self._look: tuple[int, Look] | None = None

    @property
    def per_slot(self) -> bool:
        """Whether each slot has a latent action of its own (InvDyn_M)."""
        return self.world_model.inverse_dynamics.per_slot

    @property
    def varies(self) -> bool:
        """Whether variability means anything: in mode `discrete` the predictor sees the prototype alone."""
        return self.world_model.config.inverse_dynamics.mode == "hybrid"

    @property
    def now(self) -> SceneMoment:
        return self.timeline.now

    @property
    def slots(self) -> Tensor:
        """Present slots (n, D)."""
        out: Tensor = self.now.state[keys.SLOTS][0].clone()
        return out

    def begin(self, start: Start) -> None:
        """Start a new timeline; the simulator of the one before is closed."""
        before = getattr(self, "start", None)
        if before is not None and before.twin is not None and before.twin is not start.twin:
            before.twin.close()
        self._imagination.reset(slots=start.slots)
        state = self._imagination.state
        present = tuple(range(self.world_model.slot_shape[0]))
        true = None if start.twin is None or self.agent is None else start.twin.first
        self.start = start
        frame, recorded = self._draw(state, present), self._recorded(0)
        self.timeline = Timeline(
            SceneMoment(0, None, 0, state, present, frozenset(), frame, true=true, recorded=recorded)
        )

    def close(self) -> None:
        """Free the simulator and the moments; there are none until the session begins again."""
        start = getattr(self, "start", None)
        if start is not None:
            if start.twin is not None:
                start.twin.close()
            del self.start, self.timeline
        self._look = None
        self._imagination = ImaginationSession(self.world_model)

    def latent(self, prototype: int, variability: float = 0.0, slot: int | None = None) -> Tensor:
        """The latent action ([N,] Z) of a key press: z = p + s * d (see `playslot_rl.play.steering`), s in standard
        deviations. With one latent per slot it goes to `slot`, the others staying as they are; None goes to all. A
        ValueError where there is no such prototype or slot.
        """
        if not 0 <= prototype < len(self.prototypes):
            raise ValueError(f"prototype: got {prototype}, expected 0 to {len(self.prototypes) - 1}")
        z = self.prototypes[prototype] + variability * self.directions[prototype]
        if not self.per_slot:
            return z
        if slot is not None:
            self._row(slot)
        out = z.new_zeros(self.world_model.latent_shape)
        out[slice(None) if slot is None else slot] = z
        return out

    def press(self, prototype: int, variability: float = 0.0, slot: int | None = None) -> SceneMoment:
        amount = f" {variability:+.1f}" if variability else ""
        where = f", slot {slot + 1}" if self.per_slot and slot is not None else ""
        return self.step(self.latent(prototype, variability, slot), f"prototype {prototype}{amount}{where}")

    def drive(self, name: str) -> SceneMoment:
        """One step by who has taken over; a ValueError where nobody has this name."""
        if name not in self.drivers:
            raise ValueError(f"driver: got {name!r}, expected one of {', '.join(self.drivers) or 'none'}")
        driver = self.drivers[name]
        return self.step(driver.choose(self), driver.title)

    @torch.no_grad()
    def step(self, latent: Tensor, label: str = "latent action") -> SceneMoment:
        """One imagined step by a latent ([N,] Z), and the decoded action in the simulator where there is one. A
        ValueError for another shape, or where the timeline is full.
        """
        if self.timeline.full:
            raise ValueError("step: got a full timeline, expected room: record it and start anew")
        if latent.shape != self.world_model.latent_shape:
            raise ValueError(f"step: got a latent of {tuple(latent.shape)}, expected {self.world_model.latent_shape}")
        self._imagination.restore(self.now.state)
        self._advance(self._imagination, latent[None])
        action, true = self._act(latent)
        code = self.world_model.inverse_dynamics.quantizer(latent)[1]
        return self._land(label, latent=latent.clone(), code=code.clone(), action=action, true=true)

    def _advance(self, imagination: ImaginationSession, latents: Tensor) -> Tensor:
        """One step from the present slots by latents (B, [N,] Z), in which the frozen ones stay: slots (B, n, D)."""
        now, rows = self.now, list(self.now.present)
        after = imagination.step(latents[:, rows] if self.per_slot else latents)
        held = [row for row, number in enumerate(rows) if number in now.frozen]
        if held:
            after[:, held] = now.state[keys.SLOTS][:, held]
            imagination.put(after)
        return after

    def _act(self, latent: Tensor) -> tuple[npt.NDArray[np.float32] | None, Frame | None]:
        """The decoded action, and what the simulator shows after it. As in imagination the latent is decoded alone: a
        decoder that reads slots learned from parsed ones.
        """
        if self.agent is None:
            return None, None
        decoder = self.agent.action_decoder
        decoded = decoder.action_range.from_unit(decoder(latent[None])[0].clamp(-1, 1))
        action: npt.NDArray[np.float32] = decoded.cpu().numpy().astype(np.float32)
        if self.start.twin is None:
            return action, None
        past = [moment.action for moment in self.timeline.path() if moment.action is not None]
        return action, self.start.twin.follow([*past, action])

    def _recorded(self, step: int) -> Frame | None:
        return None if self.start.recorded is None else self.start.recorded.at(step)

    def _land(self, label: str, **found: Any) -> SceneMoment:
        now, state = self.now, self._imagination.state
        whole = {"present": now.present, "frozen": now.frozen, "true": now.true, **found}
        steps = now.steps + ("latent" in found)
        moment = SceneMoment(
            number=len(self.timeline.moments),
            parent=now.number,
            depth=now.depth + 1,
            state=state,
            frame=self._draw(state, whole["present"], len(self.timeline.moments)),
            recorded=self._recorded(steps),
            steps=steps,
            label=label,
            **whole,
        )
        self.timeline.add(moment)
        return moment

    def undo(self) -> bool:
        """Back by one moment; False at the start. What was undone stays in the timeline, as a branch."""
        return self.timeline.back()

    def go(self, number: int) -> None:
        self.timeline.go(number)

    def reset(self) -> None:
        self.timeline.go(0)

    def _row(self, slot: int) -> int:
        if slot not in self.now.present:
            there = ", ".join(str(number) for number in self.now.present)
            raise ValueError(f"slot: got {slot}, expected one that is there: {there}")
        return self.now.present.index(slot)

    def freeze(self, slot: int, frozen: bool = True) -> SceneMoment:
        """Hold a slot as it is from here on, or let it go; the others see it. A ValueError where it is not there."""
        self._row(slot)
        self._imagination.restore(self.now.state)
        held = self.now.frozen | {slot} if frozen else self.now.frozen - {slot}
        return self._land(f"slot {slot + 1} {'frozen' if frozen else 'let go'}", frozen=held)

    def remove(self, slot: int) -> SceneMoment:
        """Go on without a slot, as if it had never been there; a ValueError where it is not there, or the last one."""
        row, present = self._row(slot), self.now.present
        if len(present) == 1:
            raise ValueError("remove: got the last slot, expected another one to stay: undo, or reset")
        self._imagination.restore(self.now.state)
        self._imagination.keep([r for r in range(len(present)) if r != row])
        rest = tuple(number for number in present if number != slot)
        return self._land(f"slot {slot + 1} removed", present=rest, frozen=self.now.frozen - {slot})

    def swap(self, slot: int, other: Tensor, name: str = "another scene") -> SceneMoment:
        """Put another slot (D,) in a slot's place; what came before is forgotten, since the new one was not in it. A
        ValueError where the slot is not there, or the other has another width.
        """
        row, slots = self._row(slot), self.slots
        if other.shape != slots[row].shape:
            raise ValueError(f"swap: got a slot of shape {tuple(other.shape)}, expected {tuple(slots[row].shape)}")
        slots[row] = other
        self._imagination.restore(self.now.state)
        self._imagination.put(slots[None], forget=True)
        return self._land(f"slot {slot + 1} swapped with that of {name}")

    @torch.no_grad()
    def _draw(self, state: Any, present: Sequence[int], number: int = 0) -> Frame:
        """The frame of a state, which becomes the present moment's look."""
        decoded = self._decode(state[keys.SLOTS][0])
        owner = owners(decoded.masks)
        objects = decoded.rgb.clamp(0, 1) * decoded.masks + (1 - decoded.masks)
        frame: Frame = to_uint8(decoded.frames)  # all is computed before the first is read
        self._look = (number, Look(frame, np.asarray(present)[owner.cpu().numpy()], to_uint8(objects)))
        return frame

    def look(self) -> Look:
        now = self.now
        if self._look is None or self._look[0] != now.number:
            self._draw(now.state, now.present, now.number)
        assert self._look is not None
        return self._look[1]

    @torch.no_grad()
    def preview(
        self,
        prototypes: Sequence[int] | None = None,
        variability: float = 0.0,
        slot: int | None = None,
        steps: int = PREVIEW,
    ) -> Frame:
        """What holding some prototypes, or all, would do here: uint8 (K', P + 1, H, W, 3), the present frame first."""
        numbers = range(len(self.prototypes)) if prototypes is None else prototypes
        now, k = self.now, len(numbers)
        ahead = ImaginationSession(self.world_model)
        ahead.restore(now.state)
        ahead.branch(k)
        latents = torch.stack([self.latent(number, variability, slot) for number in numbers])
        seen = [self._decode(self._advance(ahead, latents)).frames for _ in range(steps)]
        return np.concatenate([np.broadcast_to(now.frame, (k, 1, *now.frame.shape)), to_uint8(torch.stack(seen, 1))], 1)
