"""What the jobs of both comparisons are told and known by, in a form that can be kept and compared."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from playslot_rl.config.compose import compose
from playslot_rl.studies.success.jobs import success_config, success_jobs, success_record
from playslot_rl.studies.video.jobs import video_config, video_jobs, video_record

OUT = Path("/comparison")
PARENTS = {"slots": "a", "dynamics": "b", "demos": "c", "videos": "d"}
ACTING = (
    "playslot,slot_oracle,resnet_oracle,slot_bc,resnet_bc,history_bc,act,act_state,diffusion,diffusion_state,autoencoder_bc,inverse_bc,"
    "slot_vpt,lapo,lapo_slots,laom,clam,"
    "dreamer,sold,caddy_policy,caddy_oracle"
)
UNLABELLED = ACTING.replace(
    "slot_bc,resnet_bc,history_bc,act,act_state,diffusion,diffusion_state,autoencoder_bc,inverse_bc,", ""
)
CHOICES: dict[str, tuple[str, ...]] = {
    "all methods": (f"methods={ACTING}", "demos=4,8", "labels=2,4", "seeds=0,1"),
    "no labels": (f"methods={UNLABELLED}", "demos=8", "seeds=2", "preset=smoke"),
    "another task": ("methods=playslot,lapo", "demos=8", "seeds=0", "env=block_push", "model.predictor.kind=ocvp_seq"),
}
VIDEO_CHOICES: dict[str, tuple[str, ...]] = {
    "all methods": ("methods=playslot,playslot_m,svg,caddy,slotformer,ocvp_seq", "seeds=0,1"),
    "a variant": ("methods=playslot,svg", "vary=model.inverse_dynamics.mode", "values=hybrid,ground_truth"),
    "a budget": ("methods=playslot,ocvp_seq", "compare_video.budget_minutes=2", "preset=smoke"),
}


def _digest(values: Any) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def job_identities() -> dict[str, Any]:
    """Everything that `jobs.json` holds: records, the config by its digest."""
    values: dict[str, Any] = {"compare": {}, "compare-video": {}}
    given = ("data.root=/videos", f"out={OUT}")
    for choice, arguments in CHOICES.items():
        config = compose([*arguments, *given, "data.demos=/demos"], "compare")
        for job in success_jobs(config, OUT):
            record = success_record(job, success_config(config, job, "pretrained/button_press"), PARENTS)
            values["compare"][f"{choice}: {job.name}"] = {**record, "config": _digest(record["config"])}
    for choice, arguments in VIDEO_CHOICES.items():
        config = compose([*arguments, *given], "compare-video")
        for video in video_jobs(config, OUT):
            record = video_record(video, video_config(config, video, "pretrained"), PARENTS, lpips=True)
            values["compare-video"][f"{choice}: {video.name}"] = {**record, "config": _digest(record["config"])}
    return values
