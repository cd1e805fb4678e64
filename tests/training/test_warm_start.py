"""Starting SAVi from another's weights."""

from __future__ import annotations

import pytest
import torch
from tiny_savi import tiny_savi

from playslot_rl.errors import CheckpointError
from playslot_rl.training.stage_slots import warm_start


def test_a_warm_start_parses_and_renders_as_its_source() -> None:
    savi, source, frames = tiny_savi(0), tiny_savi(1), torch.rand(1, 3, 3, 32, 32)
    assert not torch.allclose(savi(frames)[0], source(frames)[0])
    warm_start(savi, source, "runs/other")
    slots = source(frames)[0]
    torch.testing.assert_close(savi(frames)[0], slots, rtol=0, atol=0)
    torch.testing.assert_close(savi.decode(slots).frames, source.decode(slots).frames, rtol=0, atol=0)


@pytest.mark.parametrize("count", [2, 5])
def test_with_another_number_of_slots_the_first_initial_ones_are_copied(count: int) -> None:
    savi, source = tiny_savi(0, n_slots=count), tiny_savi(1)
    own = savi.initializer.mean.detach().clone()
    warm_start(savi, source, "runs/other")
    both = min(count, 3)
    assert torch.equal(savi.initializer.mean[:both], source.initializer.mean[:both])
    assert torch.equal(savi.initializer.mean[both:], own[both:])


def test_the_source_stays_as_it_is_when_the_copy_learns() -> None:
    savi, source = tiny_savi(0), tiny_savi(1)
    before = {name: value.clone() for name, value in source.state_dict().items()}
    warm_start(savi, source, "runs/other")
    with torch.no_grad():
        for weight in savi.parameters():
            weight.add_(1.0)
    assert all(torch.equal(before[name], value) for name, value in source.state_dict().items())


@pytest.mark.parametrize("changes", [{"slot_dim": 32}, {"initial": "gaussian"}, {"decoder_position": "learned"}])
def test_other_sizes_are_refused_in_one_line(changes: dict[str, object]) -> None:
    with pytest.raises(CheckpointError, match=r"slots\.start_from=runs/other: got \S+ of .*, expected .*") as caught:
        warm_start(tiny_savi(0, **changes), tiny_savi(1), "runs/other")
    assert "\n" not in str(caught.value)
