"""What a latent says about a known move: a linear probe with whole clips held out.

Shapes: M transitions of single objects, D width of what the probe sees.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.evaluation.hold_out import hold_out

HELD_OUT = 0.3


def probe_moves(
    features: npt.NDArray[np.float32],
    moves: npt.NDArray[np.int64],
    clips: npt.NDArray[np.int64],
    classes: int,
    seed: int = 0,
    held_out: float = HELD_OUT,
) -> dict[str, Any]:
    """Accuracy of multinomial logistic regression on clips that it was not fitted on.

    Args:
        features: (M, D) what the probe sees, such as the prototype of the object's slot.
        moves: (M,) labels from 0 to `classes` - 1.
        clips: (M,) clip of each transition; whole clips are held out.
        classes: number of moves.
        seed: of the split.
        held_out: fraction of clips held out.

    Returns:
        `accuracy` (0 to 1); beside it `chance` (1 / classes) and `majority` (always the most frequent move of the
        fitted clips); `train` and `test` count transitions, `test_clips` clips.

    Raises:
        ValueError: sizes differ, or there are fewer than two clips.
    """
    if not len(features) == len(moves) == len(clips):
        raise ValueError(f"probe_moves: got {len(features)}, {len(moves)} and {len(clips)} rows, expected as many each")
    test, test_clips = hold_out(clips, held_out, seed, "probe_moves: clip")
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    common = int(np.bincount(moves[~test], minlength=classes).argmax())
    if len(np.unique(moves[~test])) > 1:
        probe = make_pipeline(StandardScaler(), LogisticRegression(C=10.0, max_iter=500))
        predicted = probe.fit(features[~test], moves[~test]).predict(features[test])
    else:
        predicted = np.full(int(test.sum()), common)
    return {
        "accuracy": float((predicted == moves[test]).mean()),
        "majority": float((moves[test] == common).mean()),
        "chance": 1.0 / classes,
        "train": int((~test).sum()),
        "test": int(test.sum()),
        "test_clips": test_clips,
    }
