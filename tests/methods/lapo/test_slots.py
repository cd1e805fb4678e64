"""LAPO on slots: what does not depend on the order of the slots, what is seen, where the latent enters."""

from __future__ import annotations

import pytest
import torch

from playslot_rl.config import PolicyConfig
from playslot_rl.methods.lapo.slots import SlotForward, SlotInverse
from playslot_rl.methods.lapo.slots_method import LAPOSlotsConfig

CONFIG = LAPOSlotsConfig(groups=2, code_dim=4, codes=4)
SIZES = PolicyConfig(dim=16, layers=2, heads=2, head_dim=8, mlp_dim=16)
Models = tuple[SlotInverse, SlotForward]


@pytest.fixture
def models() -> Models:
    torch.manual_seed(0)
    inverse, forward = SlotInverse(CONFIG, SIZES, 6), SlotForward(CONFIG, SIZES, 6)
    inverse(torch.randn(16, 3, 5, 6))
    torch.nn.init.normal_(forward.out.weight)
    return inverse.eval(), forward.eval()


def test_the_latent_does_not_depend_on_the_order_of_the_slots_and_the_prediction_follows_it(models: Models) -> None:
    inverse, forward = models
    slots, order, z = torch.randn(4, 3, 5, 6), torch.tensor([3, 0, 4, 1, 2]), torch.randn(4, 8)
    torch.testing.assert_close(inverse(slots[:, :, order]).before, inverse(slots).before)
    torch.testing.assert_close(forward(slots[:, :2, order], z), forward(slots[:, :2], z)[:, order])


def test_the_latent_tells_what_came_first(models: Models) -> None:
    slots = torch.randn(4, 3, 5, 6)
    assert not torch.allclose(models[0](slots.flip(1)).before, models[0](slots).before)


@pytest.mark.parametrize("place", ["to_input", "to_middle"])
def test_the_latent_enters_at_the_input_and_at_the_middle(models: Models, place: str) -> None:
    forward = models[1]
    for name in {"to_input", "to_middle"} - {place}:
        torch.nn.init.zeros_(getattr(forward, name).weight)
    past = torch.randn(1, 2, 5, 6)
    assert not torch.allclose(forward(past, torch.zeros(1, 8)), forward(past, torch.ones(1, 8)))


def test_the_forward_model_starts_from_no_change() -> None:
    past = torch.randn(2, 2, 5, 6)
    assert torch.equal(SlotForward(CONFIG, SIZES, 6)(past, torch.randn(2, 8)), past[:, -1])
